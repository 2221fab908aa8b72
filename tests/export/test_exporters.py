"""Exporters in turn: which one is taken, what each is refused for, and what no comparison may miss."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from vlatool.data import random_observations
from vlatool.errors import GraphError, SourceError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import torch_policy
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context, Result

YAML = """\
name: small
source: policy.py:make
spec:
  inputs: [{name: x, shape: [1, 3]}]
  outputs: [{name: y, shape: [1, 2]}]
  control_hz: 10
"""
CODE = """\
import torch
import torch.nn.functional as F
from torch import nn


class Body(nn.Module):
    def __init__(self):
        super().__init__()
        self.first, self.second = nn.Linear(3, 8), nn.Linear(8, 2)
        self.drop, self.scale = nn.Dropout(0.5), nn.Parameter(torch.full((1,), 0.5))
        self.register_buffer("seen", torch.zeros(1))

    def forward(self, x):
        BODY


class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = Body()

    def forward(self, x):
        return self.body(x)


def make():
    torch.manual_seed(0)
    return Policy()
"""
Export = Callable[..., Result]


@pytest.fixture
def export(tmp_path: Path) -> Export:
    """A function that exports a policy whose ``forward`` is the given lines, and compares it with torch."""

    def make(body: str, **options: object) -> Result:
        (tmp_path / "policy.yaml").write_text(YAML)
        (tmp_path / "policy.py").write_text(CODE.replace("BODY", body.replace("\n", "\n        ")))
        for name in ("source", "out"):
            (tmp_path / name).mkdir()
        source = TorchModule(policy=tmp_path).run(None, tmp_path / "source", Context()).bundle
        result = ExportOnnx(**options).run(source, tmp_path / "out", Context())
        torch, graphs = torch_policy(source), load(result.bundle.path, threads=1)
        for observation in random_observations(source.manifest.spec, 8, seed=7):
            assert relative_error(graphs.infer(observation).chunk, torch.infer(observation).chunk) < 1e-4
        return result

    return make


def ops(result: Result) -> dict[str, str]:
    graph = onnx.load(result.bundle.path / "graphs/main.onnx").graph
    return {node.name: node.op_type for node in graph.node}


PLAIN = "return self.second(torch.tanh(self.first(x)))"


@pytest.mark.parametrize("exporter", ["dynamo", "split", "legacy", "trace"])
def test_each_exporter_gives_what_torch_gives_and_names_nodes_by_module(export: Export, exporter: str) -> None:
    result = export(PLAIN, exporter=exporter)
    assert {"body.first/Gemm", "body.second/Gemm"} <= set(ops(result))
    assert result.messages == (() if exporter == "dynamo" else (f"main: exported by {exporter}",))


CHECKED = "h = self.first(x)\nif h.abs().max() > 1e6:\n    raise ValueError('off')\nreturn self.second(h * self.scale)"
INSIDE = "return self.second(self.first(x)) + (0 if self.training or float(x.sum()) < 1e9 else 1)"


def test_a_check_between_modules_is_exported_by_the_parts(export: Export) -> None:
    result = export(CHECKED)
    assert result.messages[0].startswith("main: exported by split; dynamo not, because: torch cannot export the graph")
    assert "data-dependent control flow" in result.messages[0]
    assert "decides by values at policy.py:" in result.messages[1]
    assert {"body.first/Gemm", "body.second/Gemm"} <= set(ops(result))


@pytest.mark.parametrize("read", ["np.asarray(x)", "np.from_dlpack(x)", "float(f'{x.sum()}')", "len(repr(x))"])
def test_each_way_out_of_a_tensor_is_named(export: Export, read: str) -> None:
    body = f"import numpy as np\nh = self.second(self.first(x))\nreturn h if np.max({read}) < 1e9 else -h"
    assert "decides by values at policy.py:" in export(body, exporter="legacy").messages[1]


OFF = "if h.abs().max() > 1e9:\n    raise ValueError\n"
RECORDED = {
    "a value set in place": f"h = self.first(x)\nh[:, 0] = 1\nh.mul_(2)\n{OFF}return self.second(h)",
    "attributes and unpacking": (
        f"h = self.first(x)\na, b = h.T.chunk(2)\n{OFF}"
        "return self.second(torch.cat([a, b]).T) + torch.zeros(2).fill_(0.25)"
    ),
    "a module twice": (
        f"h = self.first(x)\nfor _ in range(3):\n    h = self.first(h[:, :3])\n{OFF}return self.second(h)"
    ),
    "reversed and named": (
        f"h = self.second(1 - F.softmax(self.first(x), dim=1))\n{OFF}return torch.add(h, 2, alpha=3)"
    ),
    "a constant of its own": f"h = self.first(x) * torch.tensor([2.0] * 8)\n{OFF}return self.second(h)",
}


@pytest.mark.parametrize("case", RECORDED)
def test_what_is_between_the_parts_is_recorded(export: Export, case: str) -> None:
    assert "exported by split" in export(RECORDED[case]).messages[0]


def test_no_modules_to_split_leads_to_the_legacy_exporter(export: Export) -> None:
    body = "if x.abs().max() > 1e6:\n    raise ValueError\nreturn x[:, :2] * self.scale"
    said = export(body).messages[0]
    assert said.startswith("main: exported by legacy; dynamo not, because: ")
    assert "; split not, because: The module of 'main' calls no two modules in turn" in said


def test_a_graph_that_onnx_runtime_refuses_is_left_to_the_next(export: Export) -> None:
    """The legacy exporter writes CumSum over bool and says nothing."""
    body = "if x.abs().max() > 1e6:\n    raise ValueError\nreturn ((x > 0).cumsum(1) * self.scale)[:, :2]"
    said = export(body).messages[0]
    assert said.startswith("main: exported by trace")
    assert "legacy not, because: ONNX Runtime does not run the graph 'main'" in said
    assert "CumSum" in said


BRANCH = "h = self.first(x)\nif x.sum() > 0:\n    return self.second(h)\nreturn self.second(h) * 2"
ALIKE = "h = self.first(x)\nif x.sum() > 0:\n    h = h + 1e-12\nreturn self.second(h)"
ROUNDED = "return self.second(self.first(x)) * float(x.sum())"


def test_a_branch_that_depends_on_the_input_is_refused_by_all(export: Export) -> None:
    with pytest.raises(GraphError) as caught:
        export(BRANCH)
    message = caught.value.message
    assert message.startswith("torch cannot export the graph 'main': data-dependent control flow")
    assert all(f" {name}: " in message for name in ("split", "legacy", "trace"))
    assert len(message.splitlines()) == 1
    assert "torch.where()" in caught.value.fix


@pytest.mark.parametrize("exporter", ["split", "legacy", "trace"])
def test_a_branch_whose_outputs_are_alike_is_refused_too(export: Export, exporter: str) -> None:
    with pytest.raises(GraphError, match=r"decides by its input at policy.py:\d+ \((True|False) for one input"):
        export(ALIKE, exporter=exporter)


@pytest.mark.parametrize("exporter", ["auto", "split", "legacy", "trace"])
def test_a_number_that_is_read_from_the_input_is_computed_or_refused(export: Export, exporter: str) -> None:
    if exporter == "auto":
        assert export(ROUNDED).messages == ()
        return
    with pytest.raises(GraphError, match="relative L2 error"):
        export(ROUNDED, exporter=exporter)


@pytest.mark.parametrize(
    "body",
    [
        "return F.dropout(self.second(self.first(x)), training=True)",
        "self.drop.train()\nreturn self.second(self.drop(self.first(x)))",
    ],
)
@pytest.mark.parametrize("exporter", ["auto", "legacy", "trace"])
def test_dropout_that_draws_is_refused_by_all(export: Export, body: str, exporter: str) -> None:
    with pytest.raises(GraphError, match="draws random numbers"):
        export(body, exporter=exporter)


@pytest.mark.parametrize("exporter", ["auto", "split", "legacy", "trace"])
def test_state_in_a_buffer_is_refused_by_all(export: Export, exporter: str) -> None:
    with pytest.raises(SourceError, match="would forget"):
        export("self.seen += x.sum()\nreturn self.second(self.first(x)) + self.seen", exporter=exporter)


ENDS = {
    "an alias of the input": "return x[:, :2]",
    "an input that changes in place": "x.add_(1)\nreturn self.second(self.first(x))",
    "a constant": "return torch.ones(1, 2) * self.scale",
    "dropout that is off": "return self.second(self.drop(self.first(x)))",
}


@pytest.mark.parametrize("exporter", ["auto", "legacy", "trace"])
@pytest.mark.parametrize("case", ENDS)
def test_outputs_and_inputs_of_a_special_kind(export: Export, case: str, exporter: str) -> None:
    assert export(ENDS[case], exporter=exporter).bundle.manifest.graphs["main"].opset == 20


def test_a_mismatch_of_one_exporter_is_left_to_the_next(export: Export) -> None:
    body = "h = self.first(x)\nreturn self.second(h * 1.5 if torch.compiler.is_exporting() else h)"
    said = export(body).messages[0]
    assert "exported by" in said
    assert "differ on the output 'y' of the graph 'main'" in said


def test_one_exporter_alone_is_tried_where_it_is_named(export: Export) -> None:
    with pytest.raises(GraphError) as caught:
        export(CHECKED, exporter="dynamo")
    assert "The other exporters" not in caught.value.message


def test_the_golden_action_is_there_whatever_exporter_made_it(export: Export) -> None:
    result = export(CHECKED)
    with np.load(result.bundle.path / "golden/golden.npz") as golden:
        assert golden["out.y"].shape == (2, 1, 2)
