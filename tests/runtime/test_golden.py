import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError, DataError, GraphError
from vlatool.files.npz import open_npz
from vlatool.runtime import load
from vlatool.runtime.arithmetic import SATURATING
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.golden import conversion_error, load_golden, load_goldens
from vlatool.runtime.policy import relative_error
from vlatool.stage.finish import GOLDEN, save_npz, write_golden

SPEC = PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0)
STEP = ProgramStep("main", {"x": "x", "m": "memory"}, {"y": "y", "n": "memory"}, keep={"memory": {"shape": [1, 2]}})
OBSERVATIONS = [{"x": np.array([1, 2], np.float32)}, {"x": np.array([1, -1], np.float32)}]


def recurrent(folder: Path) -> Bundle:
    """``y = memory + x``, and the memory becomes ``y``."""
    (folder / "graphs").mkdir(parents=True)
    value = helper.make_tensor_value_info
    nodes = [helper.make_node("Add", ["x", "m"], ["y"]), helper.make_node("Identity", ["y"], ["n"])]
    inputs, outputs = ([value(name, 1, (1, 2)) for name in names] for names in ("xm", "yn"))
    graph = helper.make_graph(nodes, "m", inputs, outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.save(model, folder / "graphs/main.onnx")
    sealed = seal(folder, Manifest("m", "1", SPEC, program=(STEP,)))
    return seal(folder, replace(sealed.manifest, graphs={"main": Graph("graphs/main.onnx")}))


@pytest.fixture
def bundle(tmp_path: Path) -> Bundle:
    draft = recurrent(tmp_path)
    write_golden(draft, OBSERVATIONS, tmp_path)
    return seal(tmp_path, replace(draft.manifest, golden=GOLDEN))


def rewritten(bundle: Bundle, change: Any) -> Bundle:
    arrays = open_npz(bundle.path / GOLDEN)
    change(arrays)
    save_npz(bundle.path / GOLDEN, arrays)
    return seal(bundle.path, bundle.manifest)


def test_golden_steps_follow_each_other_without_a_reset(bundle):
    assert [golden[2].tolist() for golden in load_goldens(bundle)] == [[[1, 2]], [[2, 1]]]
    first = load_golden(bundle)
    assert first is not None
    assert first[2].tolist() == [[1, 2]]


@pytest.mark.parametrize("warmup", [1, 2, 5])
def test_they_are_replayed_in_the_same_way(bundle, warmup):
    policy = load(bundle.path, warmup=warmup)
    assert policy.golden_error == 0.0
    assert policy.infer(OBSERVATIONS[0]).chunk.tolist() == [[1, 2]]


def test_a_policy_whose_state_is_dropped_is_refused(bundle):
    dropped = replace(STEP, gives={"y": "y"})
    seal(bundle.path, replace(bundle.manifest, program=(dropped,)))
    with pytest.raises(GraphError, match="a different golden action"):
        load(bundle.path)
    noisy = replace(STEP, gives={"y": "y"}, keep={}, noise={"memory": {"shape": [1, 2], "distribution": "zeros"}})
    seal(bundle.path, replace(bundle.manifest, program=(noisy,)))
    with pytest.raises(GraphError, match="a different golden action"):
        load(bundle.path)


def test_a_program_that_keeps_values_needs_two_golden_steps(bundle):
    def cut(arrays: dict[str, Any]) -> None:
        arrays.update({name: array[:1] for name, array in arrays.items()})

    with pytest.raises(BundleError, match="has one step; a policy that keeps values needs 2"):
        load(rewritten(bundle, cut).path)


def test_one_observation_gives_two_golden_steps(tmp_path: Path):
    draft = recurrent(tmp_path)
    write_golden(draft, OBSERVATIONS[:1], tmp_path)
    sealed = seal(tmp_path, replace(draft.manifest, golden=GOLDEN))
    assert [golden[2].tolist() for golden in load_goldens(sealed)] == [[[1, 2]], [[2, 4]]]


def test_a_golden_bomb_is_refused_before_it_is_unpacked(bundle, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "golden_bytes=2e6")
    bomb = rewritten(bundle, lambda arrays: arrays.update(bomb=np.zeros(3_000_000, np.uint8)))
    assert (bundle.path / GOLDEN).stat().st_size < 10_000
    with pytest.raises(DataError, match="the limit 'golden_bytes' allows 2000000"):
        load(bomb.path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"in.x": None}, "it has no 'in.x'"),
        ({"out.y": None}, "it has no 'out.y'"),
        ({"out.y": np.array(["a", "b"])}, "no numbers"),
        ({"out.y": np.zeros((0, 1, 2))}, "no steps"),
        ({"in.x": np.array(1.0)}, "no steps"),
        ({"out.y": np.zeros((3, 1, 2))}, r"arrays have \[2, 3\] steps"),
        ({"in.x": np.zeros((100, 2)), "out.y": np.zeros((100, 1, 2))}, "the limit 'golden_steps'"),
        ({"in.x": np.zeros((2, 7), np.float32)}, "has the shape"),
        ({"in.x": np.zeros((2, 2), np.complex64)}, "complex64"),
        ({"noise.z": np.zeros((2, 2))}, "draws no noise 'z'"),
        ({"noise.z": np.array(["a", "b"])}, "no numbers"),
    ],
    ids=lambda value: "" if isinstance(value, str) else " ".join(value),
)
def test_a_golden_file_that_does_not_fit_is_told(bundle, change, message):
    def changed(arrays: dict[str, Any]) -> None:
        for name, value in change.items():
            arrays[name] = value
            if value is None:
                del arrays[name]

    with pytest.raises(DataError, match=message):
        load(rewritten(bundle, changed).path)


def test_other_statistics_of_the_action_show_in_the_golden_chunk(float_bundle, copied, resealed):
    bundle = copied(float_bundle)
    file = bundle.path / "assets/statistics.json"
    table = json.loads(file.read_text())
    table["action"]["std"] = [-2 * abs(value) if value < 0 else 2 * value for value in table["action"]["std"]]
    file.write_text(json.dumps(table))
    with pytest.raises(GraphError, match="a different golden action"):
        load(resealed(bundle).path)


def test_other_statistics_of_a_small_element_show_beside_a_large_one(float_bundle, copied, resealed):
    """Millimetres of an arm beside a gripper of 0 to 1."""
    bundle = copied(float_bundle)
    file = bundle.path / "assets/statistics.json"
    table = json.loads(file.read_text())
    table["action"]["std"] = [0.001, 1.0]
    file.write_text(json.dumps(table))
    write_golden(resealed(bundle), [golden[0] for golden in load_goldens(bundle)], bundle.path)
    right = load(resealed(bundle).path)
    assert right.golden_chunk_error == pytest.approx(0, abs=1e-4)
    table["action"]["std"] = [0.002, 1.0]
    file.write_text(json.dumps(table))
    with pytest.raises(GraphError, match="a different golden action in physical units"):
        load(resealed(bundle).path)


NEGATED = {"op": "scale", "parts": [0], "factor": -1}
RELATIVE = {"op": "relative", "to": "x", "parts": ["arm"]}
OTHER_CONVERSIONS = {
    "another sign": (NEGATED, [{**NEGATED, "factor": 1}], {}),
    "another part": (NEGATED, [{**NEGATED, "parts": [1]}], {}),
    "another bound": ({"op": "clip", "low": -1.5, "high": 1.5}, [{"op": "clip", "low": -1.5, "high": 1.4}], {}),
    "another order": ([NEGATED, {"op": "scale", "factor": 1, "offset": 2}],
                      [{"op": "scale", "factor": 1, "offset": 2}, NEGATED], {}),
    "a name of another part": (RELATIVE, [RELATIVE], {"arm": [1, 2]}),
    "absolute, no longer relative": (RELATIVE, [], {}),
    "one where there was none": ([], [NEGATED], {}),
}  # fmt: skip


@pytest.mark.parametrize("kind", OTHER_CONVERSIONS)
def test_another_conversion_of_the_action_shows_in_the_golden_file(tmp_path: Path, kind: str):
    """Also where a tolerance allows another action: the conversion is the same on each machine."""
    first, then, places = OTHER_CONVERSIONS[kind]
    x = TensorSpec("x", (1, 2), parts={"arm": (0, 1)})
    y = TensorSpec("y", (1, 2), parts={"arm": (0, 1)}, convert=tuple(first if isinstance(first, list) else [first]))
    sealed = seal(tmp_path, replace(recurrent(tmp_path).manifest, spec=replace(SPEC, inputs=(x,), outputs=(y,))))
    write_golden(sealed, OBSERVATIONS, tmp_path)
    bundle = seal(tmp_path, replace(sealed.manifest, golden=GOLDEN, golden_tolerance=0.5))
    right = load(bundle.path)
    assert right.golden_conversion_error == 0
    changed = replace(y, convert=tuple(then), parts=places or y.parts)
    seal(tmp_path, replace(bundle.manifest, spec=replace(SPEC, inputs=(x,), outputs=(changed,))))
    with pytest.raises(BundleError, match="makes another action of the golden one than recorded") as caught:
        load(bundle.path)
    assert "policy.yaml" in caught.value.fix

    def drop(arrays: dict[str, Any]) -> None:
        del arrays["robot_chunk.y"]

    assert load(rewritten(bundle, drop).path).golden_conversion_error is None  # as it was before it was recorded


@pytest.mark.parametrize(("got", "error"), [
    ([[1, 100], [2, -100]], 0), ([[1, 100], [2, -90]], 0.1), ([[1, 100], [1.8, -100]], 0.1), ([[1, 100]], np.inf),
    ([[1, 100, 0], [2, -100, 0]], np.inf),
])  # fmt: skip
def test_a_conversion_is_compared_element_by_element(got: list[list[float]], error: float):
    assert conversion_error(np.array(got), np.array([[1, 100], [2, -100]])) == pytest.approx(error)
    assert conversion_error(np.array([[1e-6, 100]]), np.array([[0.0, 100]])) == pytest.approx(1e-6)
    assert conversion_error(np.zeros((1, 2)), np.zeros((1, 2))) == 0


def test_chunks_of_other_sizes_differ_without_bound(float_bundle):
    policy = load(float_bundle.path)
    assert policy.chunk_error(np.zeros((4, 2)), np.zeros((3, 2))) == np.inf
    assert policy.chunk_error(np.full((4, 2), np.nan), np.zeros((4, 2))) != 0


def scaled(bundle: Bundle, key: str, factor: float) -> Bundle:
    def change(arrays: dict[str, Any]) -> None:
        arrays[key] = arrays[key] * factor

    return rewritten(bundle, change)


@pytest.mark.parametrize(("key", "where"), [("out.y", " than"), ("chunk.y", " in physical units than")])
def test_each_golden_action_has_a_tolerance_of_its_own(bundle, key, where):
    """What is allowed of one is not allowed of the other."""
    manifest = replace(bundle.manifest, golden_tolerance=0.01, golden_chunk_tolerance=0.3)
    if key == "chunk.y":
        manifest = replace(manifest, golden_tolerance=0.3, golden_chunk_tolerance=0.01)
    scaled(seal(bundle.path, manifest), key, 1 / 1.1)
    with pytest.raises(
        GraphError, match=rf"a different golden action{where} recorded: relative error 0\.1, allowed 0\.01"
    ):
        load(bundle.path)
    policy = load(bundle.path, golden_tolerance=0.2)
    found = (policy.golden_error, policy.golden_chunk_error)
    assert found == pytest.approx((0.1, 0) if key == "out.y" else (0, 0.1), abs=1e-6)


def test_a_bundle_from_before_has_one_tolerance_for_both(bundle):
    scaled(seal(bundle.path, replace(bundle.manifest, golden_tolerance=0.2)), "chunk.y", 1 / 1.1)
    assert "golden_chunk_tolerance" not in (bundle.path / "manifest.json").read_text()
    assert load(bundle.path).golden_tolerances == (0.2, 0.2)


def test_another_engine_than_the_bundle_was_made_for_is_told(bundle):
    pytest.importorskip("openvino")
    scaled(bundle, "out.y", 2.0)
    with pytest.raises(GraphError, match="a different golden action") as caught:
        load(bundle.path, engine="openvino")
    assert "was made for ort_cpu: load it with engine='ort_cpu'" in caught.value.fix
    with pytest.raises(GraphError, match="a different golden action") as caught:
        load(bundle.path)
    assert "was made for" not in caught.value.fix


def test_an_action_of_another_size_is_another_action(bundle):
    assert relative_error(np.zeros((1, 4)), np.zeros((1, 2))) == np.inf

    def widened(arrays: dict[str, Any]) -> None:
        arrays["out.y"] = np.zeros((2, 1, 3))

    with pytest.raises(GraphError, match="relative error inf"):
        load(rewritten(bundle, widened).path)


def test_arithmetic_that_is_not_exact_is_told_of_an_int8_policy_alone(int8_bundle, float_bundle, monkeypatch):
    monkeypatch.setattr(OrtCpuSession, "arithmetic", staticmethod(lambda: SATURATING))
    for bundle, told in ((int8_bundle, True), (float_bundle, False)):
        policy = load(bundle.path)
        with pytest.raises(GraphError, match="a different golden action") as caught:
            policy.warm_up(1, tolerance=-1.0)
        assert ("int8 products are saturating" in caught.value.message) == told
        assert ("--reduce-range" in caught.value.fix) == told


def test_where_openvino_saturates_the_remedy_is_what_was_seen_to_be_right(int8_bundle, monkeypatch):
    pytest.importorskip("openvino")
    monkeypatch.setattr(OpenvinoSession, "arithmetic", staticmethod(lambda: SATURATING))
    policy = load(int8_bundle.path, engine="openvino", golden_tolerance=1.0)  # it may saturate here, too
    with pytest.raises(GraphError, match="saturating") as caught:
        policy.warm_up(1, tolerance=-1.0)
    assert {*re.findall(r"--[a-z-]+", caught.value.fix)} == {"--reduce-range", "--layout"}


@pytest.mark.parametrize(
    ("engine", "said", "words"),
    [
        ("openvino", "AVX2", r"^This machine \(OpenVINO confined to AVX2 by ONEDNN_MAX_CPU_ISA\) computes a different"),
        ("openvino", "", "^This machine computes a different"),
        ("ort_cpu", "AVX2", "^This machine computes a different"),
    ],
)
def test_what_openvino_is_confined_to_is_no_machine(float_bundle, monkeypatch, engine, said, words):
    """An evaluation for a board runs in a child that is confined to the board's instruction set."""
    if engine == "openvino":
        pytest.importorskip("openvino")
    policy = load(float_bundle.path, engine=engine)
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", said)
    with pytest.raises(GraphError, match=words):
        policy.warm_up(1, tolerance=-1.0)
