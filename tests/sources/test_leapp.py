"""LEAPP bundles, written by LEAPP itself: one graph, several, memories, initial values; and broken ones."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from _torch_files import bundle_of, quiet

from vlatool.bundle.bundle import Bundle
from vlatool.data import random_observations
from vlatool.errors import SourceError
from vlatool.runtime import load
from vlatool.sources import source_stage
from vlatool.stage.base import Context

leapp = pytest.importorskip("leapp", reason="leapp writes the bundles")

JOINTS = ["shoulder", "elbow", "wrist"]


def arm() -> None:
    """Joint positions and velocities, the last action as a memory that begins at 0.5, and a rate."""
    import torch
    from leapp import GraphConfigs, InputKindEnum, OutputKindEnum, TensorSemantics, annotate

    net = torch.nn.Sequential(torch.nn.Linear(6, 16), torch.nn.ELU(), torch.nn.Linear(16, 3)).eval()
    names = [None, JOINTS]
    leapp.start(name="arm")
    position, velocity = annotate.input_tensors(
        "policy",
        [
            TensorSemantics("position", torch.randn(1, 3), kind=InputKindEnum.JOINT_POSITION, element_names=names),
            TensorSemantics("velocity", torch.randn(1, 3), kind=InputKindEnum.JOINT_VELOCITY, element_names=names),
        ],
    )
    last = annotate.state_tensors("policy", {"last": torch.full((1, 3), 0.5)})
    action = net(torch.cat([position, velocity], 1)) + 0.1 * last
    annotate.update_state("policy", {"last": action})
    kind = OutputKindEnum.JOINT_POSITION
    given = TensorSemantics("targets", action, kind=kind, element_names=names)
    annotate.output_tensors("policy", [given], export_with="onnx")
    leapp.stop()
    leapp.compile_graph(visualize=False, graph_configs=GraphConfigs(frequency=50.0))


def two() -> None:
    """Two graphs, of which the second reads the first."""
    import torch
    from leapp import annotate

    weight = torch.randn(8, 4)
    leapp.start(name="two")
    seen = annotate.input_tensors("features", {"obs": torch.randn(1, 8)})
    scaled = annotate.output_tensors("features", {"scaled": (seen - seen.mean()) / 2}, export_with="onnx")
    scaled = annotate.input_tensors("policy", {"scaled": scaled})
    annotate.output_tensors("policy", {"action": torch.tanh(scaled @ weight)}, export_with="onnx")
    leapp.stop()
    leapp.compile_graph(visualize=False)


def recurrent() -> None:
    """A GRU cell whose state comes back."""
    import torch
    from leapp import annotate

    cell, head = torch.nn.GRUCell(12, 8).eval(), torch.nn.Linear(8, 4).eval()
    leapp.start(name="recurrent")
    seen = annotate.input_tensors("policy", {"obs": torch.randn(1, 12)})
    state = annotate.state_tensors("policy", {"h": torch.zeros(1, 8)})
    after = cell(seen, state)
    annotate.update_state("policy", {"h": after})
    annotate.output_tensors("policy", {"action": head(after)}, export_with="onnx")
    leapp.stop()
    leapp.compile_graph(visualize=False)


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a LEAPP bundle of each kind."""
    import torch

    root, before = tmp_path_factory.mktemp("leapp"), os.getcwd()
    os.chdir(root)
    try:
        with quiet():
            torch.manual_seed(0)
            for make in (arm, two, recurrent):
                make()
    finally:
        os.chdir(before)
    return root


def of_leapp(folder: Path) -> Callable[[dict[str, Any]], Any]:
    """Return what LEAPP's own runtime answers, observation after observation."""
    import torch

    [file] = folder.glob("*.yaml")
    with quiet():
        manager = leapp.InferenceManager(str(file))
    [node] = manager.pipeline["inputs"]

    def answer(observation: dict[str, Any]) -> Any:
        inputs = {f"{node}/{name}": torch.from_numpy(np.asarray(value)[None]) for name, value in observation.items()}
        with quiet():
            return manager.run_policy(inputs)

    return answer


@pytest.mark.parametrize("name", ["arm", "two", "recurrent"])
def test_it_answers_as_leapp_does_over_an_episode(bundles: Path, tmp_path: Path, name: str) -> None:
    bundle = bundle_of(bundles / name, tmp_path / "out")
    policy, answer = load(bundle.path, threads=1), of_leapp(bundles / name)
    for observation in random_observations(bundle.manifest.spec, 50, seed=3):
        [wanted] = answer(observation).values()
        got = policy.infer(observation).outputs[bundle.manifest.spec.action.name]
        np.testing.assert_allclose(got, wanted.numpy(), rtol=1e-5, atol=1e-6)


def test_names_kinds_and_the_rate_come_from_the_bundle(bundles: Path, tmp_path: Path) -> None:
    spec = bundle_of(bundles / "arm", tmp_path / "out").manifest.spec
    assert spec.control_hz == 50
    assert [(each.name, each.labels) for each in spec.inputs] == [
        ("position", tuple(JOINTS)),
        ("velocity", tuple(JOINTS)),
    ]
    assert (spec.action.name, spec.action.labels, spec.action.mode) == ("targets", tuple(JOINTS), "absolute")
    assert spec.unknown() == ("unit of 'targets'",)


def changed(folder: Path, copy: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    shutil.copytree(folder, copy)
    [file] = copy.glob("*.yaml")
    data = yaml.safe_load(file.read_text())
    change(data)
    file.write_text(yaml.safe_dump(data, sort_keys=False))
    return copy


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "another backend": (
        lambda data: data["models"]["policy"]["parameters"].update(backend="jit"),
        "'policy' for the backend 'jit'",
    ),
    "kernels of Warp": (lambda data: data["models"]["policy"]["parameters"].update(warp_segments=2), "kernels of Warp"),
    "a missing file": (
        lambda data: data["models"]["policy"]["parameters"].update(model_path="gone.onnx"),
        "names gone.onnx, which is not beside it",
    ),
    "a file outside": (
        lambda data: data["models"]["policy"]["parameters"].update(model_path="../../etc/passwd"),
        "names the file '../../etc/passwd'",
    ),
    "another file": (
        lambda data: data["models"]["policy"]["parameters"].update(sha256sum="0" * 64),
        "its SHA-256 differs",
    ),
    "no outputs": (lambda data: data["pipeline"].update(outputs={}), "names no outputs"),
    "a name that no graph has": (
        lambda data: data["pipeline"].update(outputs={"policy": ["actions"]}),
        "names the output 'policy/actions', which its graph lacks",
    ),
    "an input that nothing feeds": (
        lambda data: data["pipeline"].update(inputs={"policy": ["position"]}),
        "Nothing feeds policy/velocity",
    ),
    "no pipeline": (lambda data: data.update(pipeline=None), "has no 'pipeline'"),
    "flows that are no lists": (
        lambda data: data["pipeline"].update(feedback_flow={"a": "b"}),
        "not a mapping of outputs",
    ),
    "initial values that are gone": (
        lambda data: data["pipeline"].update(initial_values="gone.safetensors"),
        "No such file: .*gone.safetensors",
    ),
    "models without inputs": (lambda data: data["models"].update(policy={}), "without inputs and outputs"),
}


@pytest.mark.parametrize("name", sorted(BROKEN))
def test_a_broken_bundle_is_told_by_its_place(bundles: Path, tmp_path: Path, name: str) -> None:
    change, says = BROKEN[name]
    folder = changed(bundles / "arm", tmp_path / "arm", change)
    stage: Any = source_stage(str(folder))
    with pytest.raises(SourceError, match=says) as caught:
        stage.read(None, Context())
    assert caught.value.fix


def test_a_memory_that_is_cut_off(bundles: Path, tmp_path: Path) -> None:
    folder = changed(bundles / "arm", tmp_path / "arm", lambda _data: None)
    [file] = folder.glob("*.safetensors")
    file.write_bytes(file.read_bytes()[:-6])
    with pytest.raises(SourceError, match="is cut off"):
        source_stage(str(folder)).check(None, None)


def test_two_bundles_in_a_directory(bundles: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(bundles / "arm", tmp_path / "arm"))
    shutil.copy(folder / "arm.yaml", folder / "other.yaml")
    with pytest.raises(SourceError, match="holds several LEAPP bundles"):
        source_stage(str(folder))
    assert isinstance(bundle_of(folder / "other.yaml", tmp_path / "out"), Bundle)
