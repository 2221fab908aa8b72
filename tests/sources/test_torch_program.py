"""Programs of torch.export as a source: static and dynamic shapes, nested inputs and outputs."""

from pathlib import Path
from typing import Any

import pytest
import torch
from _torch_files import Camera, assert_same, bundle_of, opened, saved, trusting
from torch import Tensor, nn

from vlatool.errors import SourceError
from vlatool.user_code import trust

__all__ = ["trusting"]


class Nested(nn.Module):
    """Inputs in a dict, outputs in a dict with a list, one of which is an input."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(16, 6)

    def forward(self, obs: dict[str, Tensor], gain: Tensor) -> Any:
        return {"action": self.net(obs["state"]) + obs["goal"], "aux": [gain * 2, gain]}


def test_a_static_program(trusting: Path) -> None:
    path = saved(Camera(), trusting / "cam.pt2", torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 5))
    bundle = bundle_of(path, trusting / "out")
    module = opened(path)

    def expected(given: Any) -> Any:
        action, memory = module(given["image"], given["memory"])
        return {"action": action, "output_1": memory}

    assert_same(bundle, expected)


def dynamic(path: Path, axis: Any, place: int = 0) -> Path:
    shapes = ({"state": {place: axis}, "goal": {place: axis} if place == 0 else None}, None)
    example = {"state": torch.rand(2, 16), "goal": torch.rand(2, 6)}, torch.rand(1, 3)
    torch.manual_seed(0)
    torch.export.save(torch.export.export(Nested().eval(), example, dynamic_shapes=shapes), path)
    trust.trust(path)
    return path


def test_nested_values_are_named_and_a_free_batch_is_one(trusting: Path) -> None:
    path = dynamic(trusting / "nested.pt2", torch.export.Dim("batch", min=1, max=8))
    bundle = bundle_of(path, trusting / "out")
    spec = bundle.manifest.spec
    assert [(each.name, each.shape) for each in spec.inputs] == [
        ("state", (1, 16)),
        ("goal", (1, 6)),
        ("gain", (1, 3)),
    ]
    assert [each.name for each in spec.outputs] == ["action", "aux.0", "aux.1"]
    module = opened(path)

    def expected(given: Any) -> Any:
        outputs = module({"state": given["state"], "goal": given["goal"]}, given["gain"])
        return {"action": outputs["action"], "aux.0": outputs["aux"][0], "aux.1": outputs["aux"][1]}

    assert_same(bundle, expected)


class Rows(nn.Module):
    """Any number of rows."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(4, 3)

    def forward(self, rows: Tensor) -> Tensor:
        return self.net(rows).mean(1)


@pytest.mark.parametrize("shape", ["rows=1,5,4", "rows=1,n,4"])
def test_other_free_axes_are_asked_for(trusting: Path, shape: str) -> None:
    path = trusting / "rows.pt2"
    axes = ({1: torch.export.Dim("count", min=1, max=64)},)
    torch.export.save(torch.export.export(Rows().eval(), (torch.rand(1, 7, 4),), dynamic_shapes=axes), path)
    trust.trust(path)
    with pytest.raises(SourceError, match="'rows' has the free axes"):
        bundle_of(path, trusting / "none")
    bundle = bundle_of(path, trusting / "out", shape=(shape,))
    module = opened(path)
    assert_same(bundle, lambda given: {"action": module(given["rows"])})


class Kept(nn.Module):
    """Writes to a buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("last", torch.zeros(1, 4))

    def forward(self, state: Tensor) -> Tensor:
        moved = state + self.last
        self.last.copy_(state)
        return moved


def test_a_program_that_changes_its_buffers_is_refused(trusting: Path) -> None:
    path = saved(Kept(), trusting / "kept.pt2", torch.rand(1, 4))
    with pytest.raises(SourceError, match="last"):
        bundle_of(path, trusting / "out")


def test_a_program_in_a_file_of_another_ending_is_named(trusting: Path) -> None:
    path = saved(Rows(), trusting / "rows.pt2", torch.rand(1, 7, 4)).rename(trusting / "rows.pt")
    with pytest.raises(SourceError, match=r"rows\.pt is a program of torch\.export, and not TorchScript"):
        bundle_of(path, trusting / "out")
