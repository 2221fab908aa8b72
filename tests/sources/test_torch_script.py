"""TorchScript as a source: scripted, traced, dicts, control flow; trusted by name, opened in a child."""

from pathlib import Path
from typing import Any

import pytest
import torch
from _torch_files import Branching, Camera, Named, Tokens, assert_same, bundle_of, opened, saved, trusting
from torch import Tensor, nn

from vlatool.errors import GraphError, SourceError
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

__all__ = ["trusting"]


def test_a_branch_is_exported_and_shapes_are_given(trusting: Path) -> None:
    path = saved(Branching(), trusting / "walker.pt")
    bundle = bundle_of(path, trusting / "out", shape=("state=1,16", "goal=1,3"))
    spec = bundle.manifest.spec
    assert bundle.manifest.name == "walker"
    assert [(each.name, each.shape) for each in spec.inputs] == [("state", (1, 16)), ("goal", (1, 3))]
    assert (spec.action.name, spec.action.shape, spec.control_hz) == ("action", (1, 6), None)
    assert spec.unknown() == ("control rate", "unit of 'action'", "mode of 'action'")
    module = opened(path)
    assert_same(bundle, lambda given: {"action": module(given["state"], given["goal"])})


def test_a_traced_module_says_its_shapes(trusting: Path) -> None:
    path = saved(Camera(), trusting / "cam.ts", torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 5))
    bundle = bundle_of(path, trusting / "out")
    assert [(each.name, each.shape) for each in bundle.manifest.spec.inputs] == [
        ("image", (1, 3, 8, 8)),
        ("memory", (1, 1, 5)),
    ]
    module = opened(path)

    def expected(given: Any) -> Any:
        action, memory = module(given["image"], given["memory"])
        return {"action": action, "output_1": memory}

    assert_same(bundle, expected)


def test_names_of_a_dict_are_kept(trusting: Path) -> None:
    path = saved(Named(), trusting / "named.pt")
    bundle = bundle_of(path, trusting / "out", shape=("observation.state=1,5", "goal=1,3"))
    assert [each.name for each in bundle.manifest.spec.outputs] == ["action", "value"]
    module = opened(path)
    assert_same(bundle, module)


def test_whole_numbers_and_a_quantized_version(trusting: Path) -> None:
    path = saved(Tokens(), trusting / "tokens.pt")
    bundle = bundle_of(path, trusting / "out", shape=("ids=1,7:int64",))
    assert bundle.manifest.spec.inputs[0].dtype == "int64"
    run_transform(DynamicInt8(), bundle, trusting / "int8", Context())


def test_a_file_that_nobody_trusted_is_not_opened(trusting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(Branching(), trusting / "walker.pt")
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(SourceError, match="changed since you trusted it") as caught:
        bundle_of(path, trusting / "out", shape=("state=1,16", "goal=1,3"))
    assert f"--trust {path}" in str(caught.value.fix)


def test_a_scripted_module_without_shapes_says_how_to_give_them(trusting: Path) -> None:
    path = saved(Branching(), trusting / "walker.pt")
    with pytest.raises(SourceError, match="does not say the shape of 'state', 'goal'") as caught:
        bundle_of(path, trusting / "out")
    assert "--shape state=1,AXIS --shape goal=1,AXIS" in str(caught.value.fix)


def test_shapes_on_which_it_fails_are_told_with_its_last_line(trusting: Path) -> None:
    path = saved(Branching(), trusting / "walker.pt")
    with pytest.raises(SourceError, match=r"cannot run on state \[1, 9\] float32, .*mat1 and mat2"):
        bundle_of(path, trusting / "out", shape=("state=1,9", "goal=1,3"))


class Counting(nn.Module):
    """Remembers how often it was called."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("calls", torch.zeros(1))

    def forward(self, state: Tensor) -> Tensor:
        self.calls += 1
        return state * self.calls


class Sized(nn.Module):
    """A list of tensors, whose number nobody says."""

    def forward(self, parts: list[Tensor]) -> Tensor:
        return torch.cat(parts, 1)


class Sorting(nn.Module):
    """An operator that ONNX lacks."""

    def forward(self, state: Tensor) -> Tensor:
        return torch.linalg.eigvalsh(state)


@pytest.mark.parametrize(
    ("module", "shape", "raised", "says"),
    [
        (Counting(), "state=1,4", SourceError, "'action' of .* is another one"),
        (Sized(), "parts=1,4", SourceError, r"takes 'parts' of the type List\[Tensor\]"),
        (Sorting(), "state=1,3,3", GraphError, "aten::.*eig"),
    ],
)
def test_what_cannot_be_a_graph_is_refused_by_name(
    trusting: Path, module: nn.Module, shape: str, raised: Any, says: str
) -> None:
    path = saved(module, trusting / "bad.pt")
    with pytest.raises(raised, match=says):
        bundle_of(path, trusting / "out", shape=(shape,))
