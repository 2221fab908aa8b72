"""Phases leave the graph that is computed in bfloat16, and the two graphs compute what the one did."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest
from onnx import numpy_helper

from vlatool.bundle.program import ProgramStep
from vlatool.graph.files import split_phases
from vlatool.graph.nodes import name_nodes
from vlatool.graph.phase import cut_phases
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.program import Program

RANDOM = np.random.default_rng(0)
WEIGHTS = {
    "w": RANDOM.standard_normal((8, 8)).astype(np.float32),
    "f": (10.0 ** np.linspace(0, 3, 4)).astype(np.float32),
    "table": RANDOM.standard_normal((5, 8)).astype(np.float32),
    "two": np.array([1, 2]),
}
TIME = """(float[1,8] x, float[1] t) => (float[1,8] y)
    { a = Unsqueeze(t, zero)  p = Mul(a, f)  s = Sin(p)  c = Cos(p)  e = Concat<axis=1>(s, c)
      h = Add(x, e)  y = MatMul(h, w) }"""
STEP = ProgramStep("main", {"x": "x", "t": "t"}, {"y": "y"})
FEEDS = {"x": RANDOM.standard_normal((1, 8)).astype(np.float32), "t": np.array([0.37], np.float32)}


def graph(text: str) -> Any:
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> g {text}')
    known = {**WEIGHTS, "zero": np.array([0])}
    read = {name for node in model.graph.node for name in node.input}
    model.graph.initializer.extend(numpy_helper.from_array(known[name], name) for name in known if name in read)
    name_nodes(model)
    return model


def run(folder: Path, model: Any, feeds: dict[str, Any], *steps: ProgramStep) -> np.ndarray[Any, Any]:
    """Run a program of one graph, or of the two that it is cut into."""
    path = folder / "main.onnx"
    onnx.save(model, path)
    program, parted = split_phases(steps, "main", path)
    sessions = {name: OrtCpuSession(folder / f"{name}.onnx", 1) for name in ("main", *parted)}
    return np.asarray(Program(program, sessions, seed=0).run(dict(feeds))["y"])


def whole(folder: Path, model: Any, feeds: dict[str, Any], *steps: ProgramStep) -> np.ndarray[Any, Any]:
    onnx.save(model, folder / "whole.onnx")
    sessions = {"main": OrtCpuSession(folder / "whole.onnx", 1)}
    return np.asarray(Program(steps, sessions, seed=0).run(dict(feeds))["y"])


def test_an_embedding_of_time_is_cut_out() -> None:
    model = graph(TIME)
    cut = cut_phases(model)
    assert cut is not None
    assert cut.inputs == ("t",)
    assert cut.values == ("s", "c")
    assert cut.kept == ("x",)
    assert [node.op_type for node in cut.model.graph.node] == ["Unsqueeze", "Mul", "Sin", "Cos"]
    assert [node.op_type for node in model.graph.node] == ["Concat", "Add", "MatMul"]
    assert [value.name for value in model.graph.input] == ["x", "s", "c"]
    assert {tensor.name for tensor in model.graph.initializer} == {"w"}
    for part in (cut.model, model):
        onnx.checker.check_model(part, full_check=True)


def test_the_two_graphs_compute_what_the_one_did(tmp_path: Path) -> None:
    np.testing.assert_array_equal(
        run(tmp_path, graph(TIME), FEEDS, STEP), whole(tmp_path, graph(TIME), FEEDS, STEP), strict=True
    )
    assert (tmp_path / "main_phases.onnx").is_file()


def test_a_program_with_noise_schedule_and_kept_values_goes_on_as_before(tmp_path: Path) -> None:
    step = ProgramStep(
        "main",
        {"x": "noise", "t": "time"},
        {"y": "y"},
        schedule={"time": [0.25]},
        noise={"noise": {"shape": [1, 8]}},
    )
    np.testing.assert_array_equal(run(tmp_path, graph(TIME), {}, step), whole(tmp_path, graph(TIME), {}, step))


def test_a_graph_that_two_steps_run_is_cut_in_both(tmp_path: Path) -> None:
    steps = (STEP, ProgramStep("main", {"x": "y", "t": "t"}, {"y": "y"}))
    np.testing.assert_array_equal(
        run(tmp_path, graph(TIME), FEEDS, *steps), whole(tmp_path, graph(TIME), FEEDS, *steps)
    )


def test_a_graph_in_a_loop_is_left_whole(tmp_path: Path) -> None:
    step = ProgramStep("main", {"x": "x", "t": "t"}, {"y": "y"}, repeat=3, carry={"y": "x"})
    onnx.save(graph(TIME), tmp_path / "main.onnx")
    before = (tmp_path / "main.onnx").read_bytes()
    assert split_phases((step,), "main", tmp_path / "main.onnx") == ((step,), {})
    assert (tmp_path / "main.onnx").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["main.onnx"]


@pytest.mark.parametrize(
    "text",
    [
        "(float[1,8] x) => (float[1,8] y) { s = Sin(table)  r = Slice(s, zero, two)  h = Add(x, r)  y = MatMul(h, w) }",
        "(float[1,8] x) => (float[1,8] y) { p = MatMul(x, w)  s = Sin(p)  y = MatMul(s, w) }",
        "(float[1,8] x) => (float[1,8] y) { h = Relu(x)  y = MatMul(h, w) }",
        "(float[1,8] x) => (float[1,8] y) { y = Sin(x) }",
        "(float[1,8] x, float[1,8] t) => (float[1,8] y, float[1,8] s) { s = Sin(t)  h = Add(x, s)  y = MatMul(h, w) }",
    ],
    ids=["constants only", "heavy ancestors", "no phase", "nothing else", "a phase that is an output"],
)
def test_what_is_not_cut(text: str) -> None:
    model = graph(text)
    before = model.SerializeToString()
    assert cut_phases(model) is None
    assert model.SerializeToString() == before


def test_values_that_both_parts_read_and_positions_by_table(tmp_path: Path) -> None:
    text = """(float[1,8] x, int64[1] t) => (float[1,8] y)
        { r = Gather(table, t)  p = Mul(r, r)  s = Sin(p)  h = Add(x, s)  k = Mul(h, p)  y = MatMul(k, w) }"""
    feeds = {"x": FEEDS["x"], "t": np.array([3])}
    np.testing.assert_array_equal(run(tmp_path, graph(text), feeds, STEP), whole(tmp_path, graph(text), feeds, STEP))
    cut = cut_phases(graph(text))
    assert cut is not None
    assert cut.values == ("p", "s")


def test_what_a_branch_reads_from_outside_survives_the_cut(tmp_path: Path) -> None:
    text = """(float[1,8] x, float[1,8] t, bool c) => (float[1,8] y)
        { s = Sin(t)  h = Add(x, s)
          y = If(c) <then_branch = a () => (float[1,8] m) { m = MatMul(h, w) },
                     else_branch = b () => (float[1,8] n) { n = Add(h, t) }> }"""
    step = ProgramStep("main", {"x": "x", "t": "t", "c": "c"}, {"y": "y"})
    model = graph(text)
    model.graph.initializer.append(numpy_helper.from_array(WEIGHTS["w"], "w"))
    for flag in (True, False):
        feeds = {"x": FEEDS["x"], "t": FEEDS["x"] * 100, "c": np.array(flag)}
        np.testing.assert_array_equal(run(tmp_path, model, feeds, step), whole(tmp_path, model, feeds, step))
