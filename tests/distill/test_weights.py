"""Weights that were trained elsewhere replace the policy's own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from vlatool.bundle.bundle import Bundle
from vlatool.distill.weights import Weights
from vlatool.errors import SourceError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import load_modules
from vlatool.rebuild.rebuild import rebuild
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform


@pytest.fixture
def tuned(source_bundle: Bundle, tmp_path: Path) -> Path:
    """A file with the tiny policy's weights, all a little larger."""
    state = load_modules(source_bundle)["main"].state_dict()
    save_file({name: (value * 1.01).contiguous() for name, value in state.items()}, str(tmp_path / "tuned.safetensors"))
    return tmp_path / "tuned.safetensors"


def test_the_weights_are_those_of_the_file(source_bundle: Bundle, tuned: Path, policy_template: Path, tmp_path: Path):
    made = run_transform(Weights(file=tuned), source_bundle, tmp_path / "made", Context()).bundle
    old, new = load_modules(source_bundle)["main"].state_dict(), load_modules(made)["main"].state_dict()
    for name, value in old.items():
        torch.testing.assert_close(new[name], (value * 1.01).to(value.dtype))
    assert "tuned.safetensors sha256:" in made.manifest.made_by["options"]["file"]
    exported = run_transform(ExportOnnx(), made, tmp_path / "exported", Context()).bundle
    again = rebuild(exported, Context(), source=str(policy_template), files=(tuned,), cache=tmp_path / "cache")
    assert again.identical


def test_another_file_is_another_bundle(source_bundle: Bundle, tuned: Path, tmp_path: Path):
    first = run_transform(Weights(file=tuned), source_bundle, tmp_path / "one", Context()).bundle
    state = load_modules(first)["main"].state_dict()
    save_file({name: (value * 2).contiguous() for name, value in state.items()}, str(tuned))
    assert run_transform(Weights(file=tuned), source_bundle, tmp_path / "two", Context()).bundle.hash != first.hash


def test_what_does_not_fit_is_named(source_bundle: Bundle, tuned: Path, tmp_path: Path):
    state = {
        f"main.{name}": value.contiguous() for name, value in load_modules(source_bundle)["main"].state_dict().items()
    }
    save_file(state, str(tuned))
    run_transform(Weights(file=tuned), source_bundle, tmp_path / "named-by-graph", Context())
    name = next(iter(state))
    save_file({key: value for key, value in state.items() if key != name}, str(tuned))
    with pytest.raises(SourceError, match=f"No tensor of .* is '{name.removeprefix('main.')}'"):
        run_transform(Weights(file=tuned), source_bundle, tmp_path / "a", Context())
    save_file({**state, name: torch.zeros(1)}, str(tuned))
    with pytest.raises(SourceError, match=r"has the shape \[1\] in"):
        run_transform(Weights(file=tuned), source_bundle, tmp_path / "b", Context())
    tuned.write_bytes(b"no safetensors")
    with pytest.raises(SourceError, match="cannot be read as safetensors"):
        run_transform(Weights(file=tuned), source_bundle, tmp_path / "c", Context())
    with pytest.raises(SourceError, match="No such file"):
        run_transform(Weights(file=tmp_path / "none"), source_bundle, tmp_path / "d", Context())


STRAYS = {
    "unknown": (
        lambda state, name: {"more.weight": torch.zeros(2)},
        "1 tensor that the policy has not: 'more",
        "else",
    ),
    "adapters": (lambda state, name: {f"{name}.lora_A.weight": torch.zeros(2)}, "holds adapters", "merge the adapters"),
    "twice": (lambda state, name: {f"main.{name}": state[name] + 1}, "twice, also as 'main.", "keep one of them"),
    "codes": (lambda state, name: {name: state[name].to(torch.int8)}, "is int8 in .* is float32", "dequantize"),
    "complex": (
        lambda state, name: {name: state[name].to(torch.complex64)},
        "is complex64 in .* is float32",
        "dequant",
    ),
}
"""What is in a file beside the weights, or in their place, and what is said of it."""


@pytest.mark.parametrize("kind", STRAYS)
def test_tensors_that_nobody_asked_for_are_refused(source_bundle: Bundle, tuned: Path, tmp_path: Path, kind: str):
    (change, message, fix), state = STRAYS[kind], load_file(tuned)
    save_file({**state, **change(state, next(iter(state)))}, str(tuned))
    with pytest.raises(SourceError, match=message) as caught:
        run_transform(Weights(file=tuned), source_bundle, tmp_path / "made", Context())
    assert fix in caught.value.fix


def test_weights_in_half_precision_are_weights(source_bundle: Bundle, tuned: Path, tmp_path: Path):
    state = load_file(tuned)
    save_file({name: value.half() if value.is_floating_point() else value for name, value in state.items()}, str(tuned))
    run_transform(Weights(file=tuned), source_bundle, tmp_path / "made", Context())
