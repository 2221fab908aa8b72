"""What every sample promises: spec, program, shapes, parameter counts, no torch at import."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from vlatool import registry
from vlatool.bundle.program import check_program, program_from
from vlatool.bundle.spec import PolicySpec, TensorSpec

MILLIONS = {
    "action_expert": 127.0,
    "openvla_like": 7498.2,
    "prefill_315m": 314.6,
    "resnet18": 11.7,
    "smolvla_like": 450.0,
    "vit_b": 86.6,
    "vit_s": 22.1,
    "vla_45m": 44.8,
}
NAMES = sorted(MILLIONS)


def graphs(name: str) -> dict[str, nn.Module]:
    made = registry.module("samples", name).make(device="meta")
    return made if isinstance(made, dict) else {"main": made}


def empty(tensor: TensorSpec) -> Tensor:
    return torch.empty([int(axis) for axis in tensor.shape], dtype=getattr(torch, tensor.dtype), device="meta")


def run_program(program: list[dict[str, Any]], parts: dict[str, nn.Module], values: dict[str, Tensor]) -> None:
    """Interpret a program on the meta device, one turn of each step; carried values must keep shape and dtype."""
    for step in program:
        for value, noise in step.get("noise", {}).items():
            values[value] = torch.empty(noise["shape"], device="meta")
        for value, numbers in step.get("schedule", {}).items():
            values[value] = torch.tensor([numbers[0]], device="meta")
            assert len(numbers) == step["repeat"]
        given = parts[step["graph"]](*[values[value] for value in step["feeds"].values()])
        given = given if isinstance(given, tuple) else (given,)
        values.update(zip(step["gives"].values(), given, strict=True))
        for source, target in step.get("carry", {}).items():
            assert values[source].shape == values[target].shape
            assert values[source].dtype == values[target].dtype


def test_the_registry_lists_exactly_the_eight() -> None:
    assert registry.names("samples") == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_forward_gives_what_the_spec_declares(name: str) -> None:
    module = registry.module("samples", name)
    spec, parts = PolicySpec.from_dict(module.SPEC), graphs(name)
    values = {tensor.name: empty(tensor) for tensor in spec.inputs}
    if isinstance(program := getattr(module, "PROGRAM", None), list):
        check_program(program_from(program), parts, spec)
        run_program(program, parts, values)
    else:
        values[spec.action.name] = parts["main"](*values.values())
    for tensor in spec.outputs:
        assert tuple(values[tensor.name].shape) == tensor.shape
        assert values[tensor.name].dtype == getattr(torch, tensor.dtype)


@pytest.mark.parametrize("name", NAMES)
def test_parameter_counts_are_as_named_and_modules_are_in_eval_mode(name: str) -> None:
    parts = graphs(name).values()
    counts = {id(parameter): parameter.numel() for part in parts for parameter in part.parameters()}
    assert sum(counts.values()) / 1e6 == pytest.approx(MILLIONS[name], abs=0.06)
    assert not any(module.training for part in parts for module in part.modules())


@pytest.mark.parametrize("name", NAMES)
def test_descriptions_are_complete_sentences_with_a_count(name: str) -> None:
    description = registry.module("samples", name).DESCRIPTION
    assert description.endswith(".")
    assert " parameters" in description
    assert "  " not in description


def test_openvla_like_is_built_under_fake_tensor_mode() -> None:
    with FakeTensorMode():
        parts = registry.module("samples", "openvla-like").make(dtype="float16")
    parameter = next(parts["decode"].parameters())
    assert parameter.dtype == torch.float16
    assert parameter.device.type == "cpu"


def test_listing_and_writing_need_no_torch(tmp_path: Any) -> None:
    code = f"""
import sys
sys.modules["torch"] = None
from pathlib import Path
from vlatool import registry
from vlatool.samples._write import write_sample
for name in registry.names("samples"):
    module = registry.module("samples", name)
    module.DESCRIPTION, module.SPEC
write_sample("action-expert", Path({str(tmp_path)!r}))
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "policy.yaml").is_file()
