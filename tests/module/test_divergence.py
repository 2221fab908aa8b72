"""Where a graph begins to differ from its module: by the name of a node, whatever the exporter folded."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.module.divergence import first_divergence
from vlatool.module.folding import fold_weights
from vlatool.module.to_onnx import exported_by_torch, name_by_module, strip_notes

TOLERANCE = 1e-3


class Block(nn.Module):
    """A layer with an operation of its own after it."""

    def __init__(self) -> None:
        super().__init__()
        self.layer, self.act = nn.Linear(8, 8), nn.Tanh()

    def forward(self, values: Any) -> Any:
        return self.act(self.layer(values)) + values


class Net(nn.Module):
    """A convolution whose normalisation is folded into it, and blocks after it."""

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.norm, self.relu = nn.Conv1d(2, 4, 3, padding=1), nn.BatchNorm1d(4), nn.ReLU()
        self.blocks = nn.ModuleList(Block() for _ in range(3))

    def forward(self, signal: Any) -> Any:
        values = self.relu(self.norm(self.conv(signal))).mean(1)
        for block in self.blocks:
            values = block(values)
        return values


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[nn.Module, Path, dict[str, Any]]:
    torch.manual_seed(0)
    module = Net().eval()
    for norm in (module.norm.running_mean, module.norm.running_var, module.norm.weight):
        norm.data.uniform_(0.5, 2)
    feeds = {"signal": np.random.default_rng(0).normal(size=(1, 2, 8)).astype(np.float32)}
    step = ProgramStep("main", {"signal": "signal"}, {"action": "action"})
    program = exported_by_torch(module, [torch.from_numpy(feeds["signal"])], step, 20)
    fold_weights(program.model)
    name_by_module(program.model)
    strip_notes(program.model)
    file = tmp_path_factory.mktemp("net") / "main.onnx"
    program.save(str(file))
    return module, file, feeds


def changed(file: Path, to: Path, node: str, kind: str) -> Path:
    model = onnx.load(file)
    [found] = [each for each in model.graph.node if each.name == node]
    found.op_type = kind
    onnx.save(model, to)
    return to


def test_a_right_graph_differs_nowhere(exported: tuple[nn.Module, Path, dict[str, Any]]) -> None:
    module, file, feeds = exported
    assert first_divergence(module, file, feeds, TOLERANCE) == ""


@pytest.mark.parametrize(
    ("node", "kind"),
    [
        ("blocks.1.act/Tanh", "Cos"),
        ("relu/Relu", "Neg"),
        ("blocks.2.act/Tanh", "Relu"),
        ("blocks.0.act/Tanh", "Abs"),
    ],
)
def test_the_first_node_that_differs_is_named(
    exported: tuple[nn.Module, Path, dict[str, Any]], tmp_path: Path, node: str, kind: str
) -> None:
    module, file, feeds = exported
    assert first_divergence(module, changed(file, tmp_path / "main.onnx", node, kind), feeds, TOLERANCE) == node
