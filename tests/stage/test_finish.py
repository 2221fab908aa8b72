import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest
from _arithmetic import products
from onnx import numpy_helper

from vlatool.bundle.bundle import Bundle, hash_file, replace_manifest, seal
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import observations_for
from vlatool.errors import GraphError
from vlatool.runtime import arithmetic, load
from vlatool.runtime.arithmetic import EXACT, SATURATING
from vlatool.runtime.engines._reference import ReferenceSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.golden import load_golden
from vlatool.stage.finish import (
    ENGINE_DIFFERENCE,
    MAX_ROUNDING,
    Difference,
    Golden,
    _judge_engine,
    carry_over,
    finish,
    read_difference,
    reseal,
    save_npz,
)


def test_equal_arrays_give_equal_bytes(tmp_path: Path):
    arrays = {"a": np.arange(5.0), "text": np.array(["x", "yz"]), "scalar": np.float32(3)}
    for name in ("one.npz", "two.npz"):
        save_npz(tmp_path / name, arrays)
    assert hash_file(tmp_path / "one.npz") == hash_file(tmp_path / "two.npz")
    with np.load(tmp_path / "one.npz", allow_pickle=False) as stored:
        for name, array in arrays.items():
            np.testing.assert_array_equal(stored[name], array)


def test_folders_are_carried_over_and_others_are_not(tmp_path: Path, float_bundle):
    carry_over(float_bundle, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["assets", "data"]
    carry_over(float_bundle, tmp_path / "other", ("assets", "no_such_folder"))
    assert sorted(path.name for path in (tmp_path / "other").iterdir()) == ["assets"]


def test_a_bundle_can_be_sealed_elsewhere_under_another_manifest(tmp_path: Path, float_bundle):
    manifest = replace(float_bundle.manifest, accuracy={"success": {"value": 0.9}})
    reseal(float_bundle, tmp_path, manifest, ("graphs", "assets", "golden"))
    opened = Bundle.open(tmp_path)
    assert opened.manifest.accuracy == {"success": {"value": 0.9}}
    assert not any(name.startswith("data/") for name in opened.manifest.files)
    assert load(tmp_path, threads=1).golden_error == pytest.approx(0, abs=1e-5)


def test_a_derived_bundle_names_its_parent_and_keeps_the_policy(source_bundle, float_bundle):
    source, made = source_bundle.manifest, float_bundle.manifest
    assert made.parent == source_bundle.hash
    assert made.made_by["stage"] == "export.onnx"
    for name in ("name", "version", "spec", "program", "environment", "parts", "description", "license"):
        assert getattr(made, name) == getattr(source, name)
    assert made.source["factory"] == "policy.py:make"
    assert "arguments" not in made.source


def again(bundle: Bundle, out: Path) -> Bundle:
    """Make a bundle with the graphs of another."""
    carry_over(bundle, out, ("assets", "data", "graphs"))
    seen = observations_for(bundle, 2)
    return finish(bundle, out, made_by={"stage": "quantize.x"}, graphs=bundle.manifest.graphs, observations=seen)


def test_the_golden_action_is_what_the_graph_says_and_not_what_the_engine_gives(float_bundle, wrong_engine, tmp_path):
    right = load_golden(again(float_bundle, tmp_path / "right"))
    wrong_engine(1.5)
    wrong = load_golden(again(float_bundle, tmp_path / "wrong"))
    np.testing.assert_array_equal(right[2], wrong[2])


@pytest.mark.parametrize("factor", [1.0, 1.008, 1.03, 1.1])
def test_the_tolerance_of_the_golden_action_is_what_was_measured_and_some_more(
    float_bundle, wrong_engine, tmp_path, factor
):
    wrong_engine(factor)
    made = again(float_bundle, tmp_path)
    policy = load(tmp_path, threads=1, accept=[ENGINE_DIFFERENCE])
    assert policy.golden_error == pytest.approx(factor - 1, abs=1e-3)
    told = (made.manifest.golden_tolerance, made.manifest.golden_chunk_tolerance)
    for seen, given in zip((policy.golden_error, policy.golden_chunk_error), told, strict=True):
        wanted = max(0.01, 1.2 * seen, min(2 * seen, 0.045))
        assert wanted <= given < wanted + 0.0011


def statistics_of_the_action(bundle: Bundle, **values: list[float]) -> None:
    file = bundle.path / "assets/statistics.json"
    table = json.loads(file.read_text())
    table["action"].update(values)
    file.write_text(json.dumps(table))


def test_a_large_mean_of_the_statistics_hides_nothing_that_an_engine_gets_wrong(
    float_bundle, wrong_engine, copied, resealed, tmp_path
):
    source = copied(float_bundle)
    statistics_of_the_action(source, mean=[1000.0, 1000.0])
    wrong_engine(1.03)
    made = again(resealed(source), tmp_path / "made").manifest
    assert made.golden_tolerance == pytest.approx(0.045, abs=0.0011)
    assert made.golden_chunk_tolerance == pytest.approx(0.045, abs=0.003)


def test_rounding_of_an_action_that_is_near_zero_in_physical_units_is_no_other_action(
    float_bundle, wrong_engine, copied, resealed, tmp_path
):
    """An open gripper is the mean less almost as much; the difference is small, what is added up is not."""
    source = copied(float_bundle)
    raw = load_golden(again(float_bundle, tmp_path / "raw"))[2].reshape(-1, 2).mean(0)
    statistics_of_the_action(source, mean=(-0.5 * raw).tolist(), std=[0.5, 0.5])
    made = again(resealed(source), tmp_path / "made")
    wrong_engine(1.008)
    policy = load(made.path, threads=1)
    assert policy.golden_chunk_error == pytest.approx(0.008, abs=1e-4)
    wrong_engine(1.02)
    with pytest.raises(GraphError, match="a different golden action than"):
        load(made.path, threads=1)


@pytest.mark.parametrize("dtype", ["float16", "int4", "int4 weights"])
def test_graphs_whose_kernels_round_otherwise_on_each_processor_may_differ_more(
    float_bundle, wrong_engine, tmp_path, dtype
):
    half = replace(float_bundle.manifest.graphs["main"], precision={dtype: 1.0})
    manifest = replace(float_bundle.manifest, graphs={"main": half})
    made = again(Bundle(float_bundle.path, manifest), tmp_path)
    assert (made.manifest.golden_tolerance, made.manifest.golden_chunk_tolerance) == (0.03, 0.03)
    wrong_engine(1.02)
    assert load(tmp_path, threads=1).golden_error == pytest.approx(0.02, abs=1e-3)


def test_int8_that_nothing_computes_exactly_here_is_a_finding(int8_bundle, float_bundle, monkeypatch, tmp_path):
    differs = [] if products("ort_cpu") == EXACT else ["engine-difference"]  # of a reference that does saturate here
    monkeypatch.setattr(arithmetic, "ort_product", lambda ort, precise=False, written=False: 0.0)
    assert again(float_bundle, tmp_path / "float").manifest.findings == ()
    found = again(int8_bundle, tmp_path / "int8").manifest.findings
    assert [each["name"] for each in found] == [*differs, "inexact-reference"]
    assert {each["stage"] for each in found} == {"quantize.x"}
    with pytest.raises(GraphError, match="Make the bundle on another machine"):
        load(tmp_path / "int8", threads=1, accept=differs)
    monkeypatch.undo()
    assert again(Bundle.open(tmp_path / "int8"), tmp_path / "again").manifest.findings == ()


def test_where_the_engine_saturates_its_finding_names_the_remedy(int8_bundle, wrong_engine, monkeypatch, tmp_path):
    monkeypatch.setattr(OrtCpuSession, "arithmetic", staticmethod(lambda: SATURATING))
    wrong_engine(1.5)
    (found,) = again(int8_bundle, tmp_path).manifest.findings
    assert "quantize again with --reduce-range" in found["message"]
    assert "int8 products are saturating" in found["message"]


def test_an_engine_that_is_further_from_the_graph_than_rounding_is_a_finding(float_bundle, wrong_engine, tmp_path):
    wrong_engine(1.03)
    assert again(float_bundle, tmp_path / "rounded").manifest.findings == ()
    wrong_engine(1.1)
    (found,) = again(float_bundle, tmp_path / "wrong").manifest.findings
    assert (found["name"], found["stage"], found["allowed"]) == ("engine-difference", "quantize.x", 0.045)
    assert found["value"] == pytest.approx(0.1, abs=1e-3)
    assert "the engine ort_cpu computes another action than the graphs say" in found["message"]


def scaled(bundle: Bundle, out: Path, factor: float) -> Bundle:
    """Make a bundle whose graph gives so many times the action of another's."""
    carry_over(bundle, out, ("assets", "data", "graphs"))
    path = out / bundle.manifest.graphs["main"].file
    model = onnx.load(path)
    (last,) = (node for node in model.graph.node if "action" in node.output)
    last.output[list(last.output).index("action")] = "unscaled"
    model.graph.initializer.append(numpy_helper.from_array(np.float32(factor), "factor"))
    model.graph.node.append(onnx.helper.make_node("Mul", ["unscaled", "factor"], ["action"]))
    onnx.save(model, path)
    seen = observations_for(bundle, 2)
    return finish(bundle, out, made_by={"stage": "quantize.x"}, graphs=bundle.manifest.graphs, observations=seen)


@pytest.mark.parametrize(
    ("engine", "found"), [(0.9, ()), (0.885, ()), (0.86, ("engine-difference",)), (1.22, ("engine-difference",))]
)
def test_an_engine_as_near_to_the_source_as_the_graphs_rounds_otherwise(
    float_bundle, wrong_engine, tmp_path, engine, found
):
    """The graphs are 0.1 from the source and the engine 0.12 or more from them, on the other side or further out."""
    wrong_engine(engine / 1.1)
    made = scaled(float_bundle, tmp_path, 1.1)
    assert tuple(each["name"] for each in made.manifest.findings) == found
    difference = abs(1.1 - engine) / 1.1
    factor = 1.2 if found else 1.5
    assert made.manifest.golden_tolerance == pytest.approx(factor * difference, abs=0.002)
    assert load(tmp_path, threads=1, accept=found).golden_error == pytest.approx(difference, abs=0.002)


def test_eight_observations_decide_whether_an_engine_rounds_otherwise(float_bundle, tmp_path, monkeypatch):
    """The engine gives 0.9 of the source on the golden observations, which is as near as the graphs, and 1.3 later."""
    real, calls = OrtCpuSession.run, itertools.count()

    def run(self, feeds):
        by = np.float32(1 if isinstance(self, ReferenceSession) else (0.9, 1.3)[next(calls) > 1] / 1.1)
        return {name: value * by for name, value in real(self, feeds).items()}

    monkeypatch.setattr(OrtCpuSession, "run", run)
    (found,) = scaled(float_bundle, tmp_path, 1.1).manifest.findings
    assert found["value"] == pytest.approx(0.182, abs=0.002)


@pytest.mark.parametrize("first", [3, 20])
def test_an_engine_that_is_wrong_on_few_observations_is_a_finding(float_bundle, tmp_path, monkeypatch, first):
    """The golden observations and many more are right: products that saturate are not there in each of them."""
    real, calls = OrtCpuSession.run, itertools.count()

    def run(self, feeds):
        by = np.float32(1.3 if not isinstance(self, ReferenceSession) and next(calls) == first else 1)
        return {name: value * by for name, value in real(self, feeds).items()}

    monkeypatch.setattr(OrtCpuSession, "run", run)
    carry_over(float_bundle, tmp_path, ("assets", "data", "graphs"))
    seen = observations_for(float_bundle, 24)
    graphs = float_bundle.manifest.graphs
    made = finish(float_bundle, tmp_path, made_by={"stage": "x"}, graphs=graphs, observations=seen, recorded=True)
    (found,) = made.manifest.findings
    assert (found["name"], found["value"]) == ("engine-difference", pytest.approx(0.3, abs=1e-3))
    difference = read_difference(made)
    assert difference == Difference(pytest.approx(0.3 / 24, abs=1e-3), pytest.approx(0.3, abs=1e-3), 24, True)


def test_a_bundle_that_was_made_from_no_graphs_is_held_against_nothing(float_bundle):
    assert read_difference(float_bundle) is None


def test_where_graphs_are_near_the_source_an_engine_beyond_rounding_is_a_finding(float_bundle, wrong_engine, tmp_path):
    wrong_engine(0.95 / 1.04)
    (found,) = scaled(float_bundle, tmp_path, 1.04).manifest.findings
    assert (found["name"], found["allowed"]) == ("engine-difference", 0.045)


def test_a_bundle_with_a_finding_is_refused_unless_it_is_overruled_by_name(float_bundle, wrong_engine, tmp_path):
    wrong_engine(1.1)
    again(float_bundle, tmp_path)
    with pytest.raises(GraphError, match=r"found to be wrong when it was made \(engine-difference\)") as caught:
        load(tmp_path, threads=1)
    assert caught.value.fix.endswith("accept the finding by name: engine-difference")
    with pytest.raises(GraphError, match="found to be wrong"):
        load(tmp_path, threads=1, accept=["another"])
    assert load(tmp_path, threads=1, accept=["engine-difference"]).spec == float_bundle.manifest.spec


def test_what_was_wrong_with_the_source_stays_but_its_engine_is_looked_at_anew(float_bundle, copied, tmp_path):
    source = copied(float_bundle)
    told = ({"name": ENGINE_DIFFERENCE, "message": "m"}, {"name": "other", "message": "o"})
    source = replace_manifest(source, replace(source.manifest, findings=told))
    assert again(source, tmp_path / "made").manifest.findings == told[1:]


def test_the_golden_file_holds_inputs_and_the_raw_action(float_bundle):
    golden = load_golden(float_bundle)
    assert golden is not None
    observation, noise, expected = golden
    assert set(observation) == {"image", "proprio", "instruction"}
    assert observation["instruction"] == "go to the ball"
    assert noise == {}
    assert expected.shape == (1, 4, 2)
    with np.load(float_bundle.file(float_bundle.manifest.golden)) as stored:
        assert len(stored["in.image"]) == 2


@pytest.mark.parametrize(("sign", "share"), [(1.01, 0.0), (-1.0, 1.0)])
def test_a_discrete_action_is_another_one_where_another_choice_is_made(tmp_path, sign, share):
    """The graph gives logits, which hardly ever stay the same to the last bit."""
    bundles = []
    for name, factor in (("before", 1.0), ("after", sign)):
        (tmp_path / name / "graphs").mkdir(parents=True)
        text = "g (float[1,3] x) => (float[1,3] y) { y = Mul(x, by) }"
        model = onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}')
        model.graph.initializer.append(numpy_helper.from_array(np.float32(factor), "by"))
        onnx.save(model, tmp_path / name / "graphs/main.onnx")
        spec = PolicySpec(
            (TensorSpec("x", (1, 3)),), (TensorSpec("y", (1, 3), kind="discrete", labels=("a", "b", "c")),), 10.0
        )
        graphs = {"main": Graph("graphs/main.onnx", {"float32": 1.0}, 20)}
        step, files = ProgramStep("main", {"x": "x"}, {"y": "y"}), {"graphs/main.onnx": FileRecord("", 0)}
        bundles.append(seal(tmp_path / name, Manifest("three", "1", spec, graphs, (step,), files)))
    seen = observations_for(bundles[0], 16)
    made = finish(bundles[0], tmp_path / "after", made_by={"stage": "x"}, graphs=graphs, observations=seen)
    difference = read_difference(made)
    assert difference is not None
    assert (difference.mean, difference.worst, difference.samples) == (share, share, 16)


@pytest.mark.parametrize(("largest", "allowed"), [(1e-7, math.inf), (1e-5, MAX_ROUNDING)])
def test_a_difference_below_the_rounding_of_one_is_none(float_bundle: Bundle, largest: float, allowed: float) -> None:
    golden = Golden([], [], difference=0.2, of_chunk=0.2, largest=largest)
    assert _judge_engine(float_bundle, golden, None) == (0.2, allowed, False)
