from dataclasses import replace
from pathlib import Path

import onnx.parser
import pytest

from vlatool.benchmark.overhead import Overhead
from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import UsageError
from vlatool.stage.base import Context


def test_the_overhead_is_the_median_over_pairs_of_rounds(float_bundle):
    told = []
    report = Overhead(iterations=400).run(float_bundle, Context(lambda what, share: told.append((what, share))))
    (row,) = report.rows
    found = row.get("overhead_p50")
    assert (found.unit, found.samples, len(row.raw["overhead_us"])) == ("us", 10, 10)
    assert found.low <= found.value <= found.high
    assert row.value("bare_run_p50") > 0
    assert report.kind == "benchmark"
    assert "infer() adds" in report.summary[0]
    assert told == [*(("measuring rounds", number / 11) for number in range(11)), ("measuring calls in turn", None)]
    in_turn = row.get("overhead_in_turn_p50")
    assert (in_turn.unit, in_turn.samples) == ("us", 400)
    assert in_turn.low <= in_turn.value <= in_turn.high


def test_a_graph_that_runs_twice_has_no_single_bare_call(float_bundle):
    step = replace(float_bundle.manifest.program[0], repeat=2)
    for program in ((step,), (step, step)):
        twice = Bundle(float_bundle.path, replace(float_bundle.manifest, program=program))
        with pytest.raises(UsageError, match="one graph that runs once"):
            Overhead(iterations=100).check(twice, None)
    Overhead().check(None, None)


SUMS = """g (float[1,2] x, float[1,2] memory, float[1,2] noise, float[1] time) => (float[1,2] y, float[1,2] kept)
    { y = Sum(x, memory, noise, time)  kept = Neg(y) }"""


def test_a_policy_that_keeps_draws_and_schedules_has_an_overhead(tmp_path: Path) -> None:
    step = ProgramStep(
        "main", {name: name for name in ("x", "memory", "noise", "time")}, {"y": "y", "kept": "memory"},
        schedule={"time": [0.5]}, noise={"noise": {"shape": [1, 2]}}, keep={"memory": {"shape": [1, 2]}},
    )  # fmt: skip
    (tmp_path / "graphs").mkdir()
    model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {SUMS}')
    onnx.save(model, str(tmp_path / "graphs/main.onnx"))
    spec = PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0)
    sealed = seal(tmp_path, Manifest("sums", "1", spec, program=(step,)))
    manifest = replace(sealed.manifest, graphs={"main": Graph("graphs/main.onnx", opset=20)})
    (row,) = Overhead(iterations=100).run(seal(tmp_path, manifest), Context()).rows
    assert row.value("bare_run_p50") > 0
