import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError, DataError, GraphError, MissingExtra, UsageError
from vlatool.runtime import Policy, load
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.policy import refuse_findings, relative_error
from vlatool.stage.finish import save_npz

LOGITS = TensorSpec("logits", (1, 3), kind="discrete", labels=("left", "right", "forward"))


def linear_bundle(folder: Path, output: TensorSpec, weight: np.ndarray, control: int = 1) -> Bundle:
    """A bundle of one MatMul: ``state`` (1, 2) times ``weight``, reshaped to the output."""
    (folder / "graphs").mkdir(parents=True)
    (folder / "assets").mkdir()
    (folder / "assets/stats.json").write_text(json.dumps({"action": {"mean": [1, 2], "std": [10, 100]}}))
    weights = [
        numpy_helper.from_array(weight.astype(np.float32), "w"),
        numpy_helper.from_array(np.array(output.shape, np.int64), "shape"),
    ]
    nodes = [helper.make_node("MatMul", ["state", "w"], ["h"]), helper.make_node("Reshape", ["h", "shape"], ["out"])]
    graph = helper.make_graph(
        nodes,
        "main",
        [helper.make_tensor_value_info("state", TensorProto.FLOAT, (1, 2))],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, output.shape)],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.save(model, folder / "graphs/main.onnx")
    spec = PolicySpec((TensorSpec("state", (1, 2)),), (output,), 10.0, chunk=control)
    program = (replace(single_graph(spec)[0], gives={"out": output.name}),)
    unhashed = Manifest("linear", "1", spec, program=program)
    sealed = seal(folder, unhashed)
    return seal(folder, replace(sealed.manifest, graphs={"main": Graph("graphs/main.onnx")}))


def damage_golden(bundle: Bundle, change: Any) -> Bundle:
    """Change arrays of the golden file and hash it again."""
    path = bundle.file(bundle.manifest.golden)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    save_npz(path, {name: change(name, value) for name, value in arrays.items()})
    return seal(bundle.path, bundle.manifest)


def test_actions_are_in_physical_units(float_bundle, observation):
    action = load(float_bundle.path, threads=1).infer(observation)
    statistics = json.loads((float_bundle.path / "assets/statistics.json").read_text())["action"]
    by_hand = action.outputs["action"][0] * np.array(statistics["std"]) + np.array(statistics["mean"])
    np.testing.assert_allclose(action.chunk, by_hand, rtol=1e-5)
    assert action.chunk.shape == (4, 2)
    assert action.chunk.dtype == np.float32
    assert action.labels == ("dx", "dy")
    assert action.latency_ms > 0


def test_inputs_are_normalised_and_outputs_unnormalised_as_computed_by_hand(float_bundle, observation):
    """The whole way by hand: numpy for the normalisation, ONNX Runtime alone for the graph."""
    statistics = json.loads((float_bundle.path / "assets/statistics.json").read_text())
    proprio, action = statistics["proprio"], statistics["action"]
    normalised = (observation["proprio"] - np.array(proprio["mean"])) / np.array(proprio["std"])
    feeds = {
        "image": observation["image"][None],
        "proprio": normalised[None].astype(np.float32),
        "instruction": np.array([[2, 3, 4, 5]]),
    }
    raw = OrtCpuSession(float_bundle.path / "graphs/main.onnx", 1).run(feeds)["action"]
    wanted = raw[0] * np.array(action["std"]) + np.array(action["mean"])
    got = load(float_bundle.path, threads=1).infer(observation).chunk
    np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-6)


def test_a_linear_policy_gives_what_a_matrix_gives(tmp_path: Path):
    spec = TensorSpec("action", (1, 2, 2), normalisation="mean_std", statistics="stats.json#action")
    weight = np.arange(8).reshape(2, 4)
    policy = load(linear_bundle(tmp_path, spec, weight, 2).path)
    np.testing.assert_allclose(policy.infer({"state": [1.0, 2.0]}).chunk, [[81, 1102], [141, 1702]])


@pytest.mark.parametrize(("state", "index"), [([1.0, 0.0], 2), ([-1.0, 0.0], 0), ([0.0, 1.0], 1)])
def test_a_discrete_action_is_the_largest_logit(tmp_path: Path, state, index):
    policy = load(linear_bundle(tmp_path, LOGITS, np.array([[1, 2, 3], [0, 9, 1]])).path)
    action = policy.infer({"state": state})
    assert action.chunk.tolist() == [index]
    assert action.chunk.dtype == np.int64
    assert action.labels == (LOGITS.labels[index],)
    assert action.outputs["logits"].shape == (1, 3)


def test_a_chunk_of_discrete_actions(tmp_path: Path):
    spec = replace(LOGITS, shape=(1, 2, 3))
    policy = load(linear_bundle(tmp_path, spec, np.array([[1, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0]]), 2).path)
    action = policy.infer({"state": [1.0, 0.0]})
    assert action.chunk.tolist() == [0, 2]
    assert action.labels == ("left", "forward")


def test_inferences_are_numbered_from_the_reset(tmp_path: Path):
    policy = load(linear_bundle(tmp_path, LOGITS, np.eye(2, 3)).path)
    assert [policy.infer({"state": [1.0, 0.0]}).sequence for _ in range(3)] == [0, 1, 2]
    policy.reset()
    assert policy.infer({"state": [1.0, 0.0]}).sequence == 0


def test_an_action_that_is_not_finite_is_never_returned(tmp_path: Path):
    policy = load(linear_bundle(tmp_path, LOGITS, np.full((2, 3), 3e38)).path)
    with pytest.raises(GraphError, match="'logits' is not finite") as caught:
        policy.infer({"state": [3e38, 3e38]})
    assert "do not execute" in caught.value.fix


def test_an_observation_that_does_not_fit_is_refused(float_bundle, observation):
    policy = load(float_bundle.path, threads=1)
    with pytest.raises(DataError, match="no 'proprio'"):
        policy.infer({name: value for name, value in observation.items() if name != "proprio"})


def test_the_same_observation_gives_the_same_action_with_and_without_batch_axis(float_bundle, observation):
    policy = load(float_bundle.path, threads=1)
    batched = {name: value if isinstance(value, str) else value[None] for name, value in observation.items()}
    np.testing.assert_array_equal(policy.infer(observation).chunk, policy.infer(batched).chunk)


def test_the_int8_policy_is_near_the_float_policy(float_bundle, int8_bundle, observation):
    wanted = load(float_bundle.path, threads=1).infer(observation).outputs["action"]
    got = load(int8_bundle.path, threads=1).infer(observation).outputs["action"]
    assert 0 < relative_error(got, wanted) < 0.1


def test_a_source_has_nothing_to_run(source_bundle):
    with pytest.raises(BundleError, match="no graph to run") as caught:
        load(source_bundle.path)
    assert "vlatool export" in caught.value.fix


def test_an_unknown_engine_gets_the_nearest_name(float_bundle):
    with pytest.raises(UsageError, match="Unknown engine 'ort-cup'; did you mean 'ort_cpu'"):
        load(float_bundle.path, engine="ort-cup")


def test_a_fresh_load_reproduces_the_golden_action(float_bundle):
    assert load(float_bundle.path, threads=1).golden_error == pytest.approx(0.0, abs=1e-5)


def test_loading_without_warm_up_skips_the_golden_check(float_bundle):
    assert load(float_bundle.path, threads=1, warmup=0).golden_error is None


def test_a_machine_that_computes_another_golden_action_is_refused(float_bundle, copied):
    def damaged(name: str, value: np.ndarray) -> np.ndarray:
        return value * 2 if name.startswith("out.") else value[:0] if name.startswith("robot_chunk.") else value

    bundle = damage_golden(copied(float_bundle), damaged)
    with pytest.raises(
        GraphError, match=r"a different golden action than recorded: relative error 0.5, allowed 0.01"
    ) as caught:
        load(bundle.path, threads=1)
    assert "vlatool doctor" in caught.value.fix
    assert load(bundle.path, threads=1, golden_tolerance=0.6).golden_error == pytest.approx(0.5, rel=1e-4)


def test_a_golden_action_of_nan_is_refused(float_bundle, copied):
    bundle = damage_golden(
        copied(float_bundle), lambda name, value: value * np.nan if name.startswith("out.") else value
    )
    with pytest.raises(GraphError, match="relative error nan"):
        load(bundle.path, threads=1)


def test_a_policy_is_as_new_after_the_warm_up(float_bundle, observation):
    assert load(float_bundle.path, threads=1).infer(observation).sequence == 0


def test_a_bundle_without_golden_file_loads_unchecked(tmp_path: Path):
    policy = load(linear_bundle(tmp_path, LOGITS, np.eye(2, 3)).path)
    assert policy.golden_error is None


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04nonsense"], ids=["empty", "nonsense", "half zip"])
def test_a_golden_file_that_cannot_be_read(float_bundle, copied, resealed, content):
    bundle = copied(float_bundle)
    bundle.file(bundle.manifest.golden).write_bytes(content)
    resealed(bundle)
    with pytest.raises(DataError, match=r"golden file .* cannot be read"):
        load(bundle.path, threads=1)


def test_a_golden_file_without_an_input(float_bundle, copied):
    bundle = copied(float_bundle)
    save_npz(bundle.file(bundle.manifest.golden), {"out.action": np.zeros((1, 1, 4, 2), np.float32)})
    seal(bundle.path, bundle.manifest)
    with pytest.raises(DataError, match=r"golden file .* cannot be read"):
        load(bundle.path, threads=1)


@pytest.mark.parametrize("length", [0, 100, 5000])
def test_a_broken_graph_is_told_without_a_traceback_of_the_engine(float_bundle, copied, resealed, length):
    bundle = copied(float_bundle)
    path = bundle.path / "graphs/main.onnx"
    path.write_bytes(path.read_bytes()[:length])
    resealed(bundle)
    with pytest.raises(GraphError, match=r"ONNX Runtime .* refuses .*main.onnx") as caught:
        load(bundle.path, threads=1)
    assert len(caught.value.message.splitlines()) == 1


def test_the_engine_runs_on_the_cpu_and_knows_its_inputs(float_bundle):
    session = OrtCpuSession(float_bundle.path / "graphs/main.onnx")
    assert session._session.get_providers() == ["CPUExecutionProvider"]
    assert str(session.takes["image"]) == "uint8 [1, 8, 8, 3]"
    assert session.outputs == ["action"]
    assert OrtCpuSession.version().count(".") == 2


def test_an_engine_that_opens_elsewhere_is_refused(float_bundle, monkeypatch):
    import onnxruntime

    class Elsewhere(onnxruntime.InferenceSession):
        def get_providers(self) -> list[str]:
            return ["AzureExecutionProvider"]

    monkeypatch.setattr(onnxruntime, "InferenceSession", Elsewhere)
    with pytest.raises(GraphError, match="opened on AzureExecutionProvider; wanted CPUExecutionProvider"):
        OrtCpuSession(float_bundle.path / "graphs/main.onnx")


def test_feeds_that_the_graph_does_not_take(float_bundle):
    session = OrtCpuSession(float_bundle.path / "graphs/main.onnx", 1)
    with pytest.raises(GraphError, match=r"ONNX Runtime failed in main.onnx: ") as caught:
        session.run({"image": np.zeros((1, 8, 8, 3), np.float32)})
    assert len(caught.value.message.splitlines()) == 1


def test_an_engine_that_is_not_installed_names_its_extra(float_bundle, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(MissingExtra, match="'ort'"):
        Policy.open(float_bundle)


def test_relative_error():
    assert relative_error(np.array([3.0, 4.0]), np.array([3.0, 4.0])) == 0
    assert relative_error(np.array([[6.0, 8.0]]), np.array([3.0, 4.0])) == pytest.approx(1.0)
    assert relative_error(np.array([0.0, 2.0]), np.array([0.0, 0.0])) == pytest.approx(2.0)


def test_an_unknown_word_warns_the_controller(float_bundle, observation):
    policy = load(float_bundle.path, threads=1)
    with pytest.warns(UserWarning, match="not trained on: fetch"):
        policy.infer({**observation, "instruction": "fetch"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy.infer({**observation, "instruction": "fetch"})


def test_what_a_manifest_says_is_wrong_is_told_without_control_characters(float_bundle):
    findings = ({"name": "\x1b[31mred", "message": "\x1b]0;title\x07 and \u202e"},)
    wrong = Bundle(float_bundle.path, replace(float_bundle.manifest, findings=findings))
    with pytest.raises(GraphError, match=r"\(\\x1b\[31mred\): \\x1b\]0;title\\x07 and \\u202e") as caught:
        refuse_findings(wrong)
    assert "\x1b" not in str(caught.value)
    refuse_findings(wrong, ["\x1b[31mred"])
