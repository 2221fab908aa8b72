"""Policy packages: statistics, names and chunks come from the manifest; its steps are data, never code."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from _foreign_onnx import F, N, V, model, weight
from _torch_files import bundle_of

from vlatool.data import random_observations
from vlatool.errors import SourceError
from vlatool.runtime import load
from vlatool.sources import is_bundle, source_stage
from vlatool.stage.base import Context

JOINTS = [f"joint{number}" for number in range(4)]
STATISTICS = {
    "observation.state": {"mean": [0.1, -0.2, 0.3, 0], "std": [1.5, 0.5, 2, 0]},
    "action": {"min": [-1.0, -2, 0, 0.5], "max": [1.0, 3, 4, 1.5]},
}
STATE = "observation.state"
CLASS = "physicalai.inference.{}processors"


def row(name: str, key: str) -> Any:
    """One statistic of a feature."""
    return np.asarray(STATISTICS[name][key], np.float32)


def manifest() -> dict[str, Any]:
    """A manifest as physical-ai-studio writes it."""
    normalize = {"mode": "mean_std", "artifact": "stats.safetensors", "features": ["observation.state"]}
    denormalize = {"mode": "min_max", "artifact": "stats.safetensors", "features": ["action"]}
    return {
        "format": "policy_package",
        "version": "1.0",
        "policy": {"name": "act"},
        "model": {
            "runner": {"type": "single_pass"},
            "artifacts": {"onnx": "act.onnx"},
            "preprocessors": [{"class_path": f"{CLASS.format('pre')}.StatsNormalizer", "init_args": normalize}],
            "postprocessors": [{"class_path": f"{CLASS.format('post')}.StatsDenormalizer", "init_args": denormalize}],
        },
        "hardware": {
            "robots": [
                {"name": "main", "state": {"shape": [4], "order": JOINTS}, "action": {"shape": [4], "order": JOINTS}}
            ]
        },
    }


def package(folder: Path, change: Callable[[dict[str, Any]], object] = lambda _data: None) -> Path:
    """Write a package: a network of one hidden layer for chunks of 5 actions."""
    from safetensors.numpy import save_file

    folder.mkdir()
    state, action = V("observation.state", F, [1, 4]), V("action", F, [1, 5, 4])
    nodes = [
        N("MatMul", ["observation.state", "W"], ["hidden"]),
        N("Tanh", ["hidden"], ["active"]),
        N("MatMul", ["active", "U"], ["row"]),
        N("Reshape", ["row", "shape"], ["action"]),
    ]
    shape = onnx.numpy_helper.from_array(np.array([1, 5, 4]), "shape")
    onnx.save(model(nodes, [weight("W", 4, 16), weight("U", 16, 20), shape], (state,), (action,)), folder / "act.onnx")
    flat = {f"{name}/{key}": row(name, key) for name, values in STATISTICS.items() for key in values}
    save_file(flat, folder / "stats.safetensors")
    data = manifest()
    change(data)
    (folder / "manifest.json").write_text(json.dumps(data))
    return folder


def expected(folder: Path, state: Any) -> Any:
    """Compute what the package says, in numpy and ONNX Runtime."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(folder / "act.onnx"), providers=["CPUExecutionProvider"])
    mean, std, low, high = row(STATE, "mean"), row(STATE, "std"), row("action", "min"), row("action", "max")
    scaled = (state - mean) / (std + np.float32(1e-8))
    [chunk] = session.run(None, {STATE: scaled[None].astype(np.float32)})
    return (chunk[0] + 1) / 2 * (high - low) + low


def test_statistics_names_and_the_chunk_come_from_the_manifest(tmp_path: Path) -> None:
    folder = package(tmp_path / "package")
    assert not is_bundle(folder)
    bundle = bundle_of(folder, tmp_path / "out")
    spec = bundle.manifest.spec
    assert (bundle.manifest.name, spec.chunk, spec.control_hz) == ("act", 5, None)
    assert spec.inputs[0].labels == spec.action.labels == tuple(JOINTS)
    policy = load(bundle.path, threads=1)
    for observation in random_observations(spec, 50, seed=2):
        observation["observation.state"][3] = 0  # a joint that never moved
        chunk = policy.infer(observation).chunk
        np.testing.assert_allclose(chunk, expected(folder, observation["observation.state"]), rtol=1e-4, atol=1e-5)


def test_it_answers_as_its_own_runtime_does(tmp_path: Path) -> None:
    own = pytest.importorskip("physicalai.inference.model", reason="physicalai runs packages", exc_type=ImportError)
    folder = package(tmp_path / "package")
    bundle, theirs = bundle_of(folder, tmp_path / "out"), own.InferenceModel(folder)
    policy = load(bundle.path, threads=1)
    for observation in random_observations(bundle.manifest.spec, 50, seed=2):
        observation["observation.state"][3] = 0
        wanted = theirs.predict_action_chunk({name: value[None] for name, value in observation.items()})
        np.testing.assert_allclose(policy.infer(observation).chunk, wanted.reshape(5, 4), rtol=1e-4, atol=1e-5)


def test_the_form_of_lerobot(tmp_path: Path) -> None:
    def flat(data: dict[str, Any]) -> None:
        data["artifacts"] = data.pop("model")["artifacts"]
        features = {"input_features": ["observation.state"], "output_features": []}
        data["normalization"] = {"type": "standard", "artifact": "stats.safetensors", **features}
        data["action"] = {"dim": 4, "chunk_size": 5, "n_action_steps": 3, "representation": "delta"}

    spec = bundle_of(package(tmp_path / "package", flat), tmp_path / "out").manifest.spec
    assert (spec.chunk, spec.execute, spec.action.mode) == (5, 3, "delta")
    assert (spec.inputs[0].normalisation, spec.action.normalisation) == ("mean_std", "none")


def step(data: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = data["model"]["preprocessors"][0]["init_args"]
    return found


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "code": (
        lambda data: data["model"]["preprocessors"].append({"class_path": "subprocess.Popen", "init_args": {}}),
        r"has the step 'subprocess\.Popen', which is code of its own",
    ),
    "a loop of its own": (lambda data: data["model"]["runner"].update(type="iterative"), "the step 'iterative'"),
    "a loop, flat": (lambda data: data.update(inference={"scheduler": "euler"}), "a loop of its own"),
    "no ONNX": (lambda data: data["model"].update(artifacts={"openvino": "act.xml"}), r"no ONNX file .*act\.xml"),
    "two graphs": (
        lambda data: data["model"].update(artifacts={"encoder": "a.onnx", "denoise": "b.onnx"}),
        "several graphs",
    ),
    "a file that is gone": (
        lambda data: data["model"].update(artifacts={"onnx": "gone.onnx"}),
        r"names gone\.onnx, which is not there",
    ),
    "a file outside": (
        lambda data: data["model"].update(artifacts={"onnx": "../other.onnx"}),
        r"names the file '\.\./other\.onnx'",
    ),
    "another version": (lambda data: data.update(version="2.0"), "the version '2.0'"),
    "another mode": (lambda data: step(data).update(mode="mean_sdt"), "normalises by 'mean_sdt'"),
    "statistics that are gone": (
        lambda data: step(data).update(artifact="gone.safetensors"),
        "No such file: .*gone.safetensors",
    ),
    "a statistic that is missing": (
        lambda data: step(data).update(mode="quantiles"),
        "lacks 'q01' of 'observation.state'",
    ),
    "a feature that the graph lacks": (
        lambda data: step(data).update(features=["action", "observation.state"], mode="mean_std"),
        "lacks 'mean' of 'action'",
    ),
    "statistics outside": (
        lambda data: step(data).update(artifact="/etc/passwd"),
        "names the statistics '/etc/passwd'",
    ),
}


@pytest.mark.parametrize("name", sorted(BROKEN))
def test_a_broken_package_is_told_by_its_place(tmp_path: Path, name: str) -> None:
    change, says = BROKEN[name]
    stage: Any = source_stage(str(package(tmp_path / "package", change)))
    (tmp_path / "out").mkdir()
    with pytest.raises(SourceError, match=says) as caught:
        stage.check(None, None) or stage.run(None, tmp_path / "out", Context())
    assert caught.value.fix
