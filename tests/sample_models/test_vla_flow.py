"""The sample policy vla-flow: two graphs, a schedule that alone says how many Euler steps are taken, its training."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from _full import small_or_full

from vlatool.bundle.bundle import Bundle, seal
from vlatool.data import recorded_observations
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.runtime import load
from vlatool.runtime.policy import Policy
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

SAMPLES = Path(__file__).parents[2] / "sample_models"
FLOW, METAWORLD = SAMPLES / "vla-flow", SAMPLES / "vla-metaworld"
Imported = SimpleNamespace


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    out = tmp_path_factory.mktemp("flow-source")
    return TorchModule(policy=FLOW).trust_code().run(None, out, Context()).bundle


@pytest.fixture(scope="module")
def exported(source: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return ExportOnnx().run(source, tmp_path_factory.mktemp("flow-exported"), Context()).bundle


@pytest.fixture(scope="module")
def observations(exported: Bundle) -> list[dict[str, Any]]:
    return list(recorded_observations(exported, 5))


@pytest.fixture
def imported(monkeypatch: pytest.MonkeyPatch) -> Iterator[Imported]:
    """The sample's own modules, as its scripts import them; gone afterwards, for other folders have the same names."""
    for folder in (FLOW, METAWORLD):
        for file in folder.glob("*.py"):  # another policy's, left behind by whatever ran before
            monkeypatch.delitem(sys.modules, file.stem, raising=False)
    before = set(sys.modules)
    elsewhere = [entry for entry in sys.path if Path(entry).parent != FLOW.parent]
    monkeypatch.setattr(sys, "path", [str(FLOW), *elsewhere])
    import flow_learning
    from batches import Batches, Budget
    from demonstrations import Frames

    yield Imported(learning=flow_learning, Batches=Batches, Budget=Budget, Frames=Frames)
    for name in set(sys.modules) - before:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).is_relative_to(SAMPLES):
            del sys.modules[name]


def with_steps(bundle: Bundle, steps: int) -> Bundle:
    """Change nothing but the schedule and how often it is gone through."""
    *before, step = bundle.manifest.program
    schedule = {"t": [1.0 - turn / steps for turn in range(steps)], "dt": [-1.0 / steps] * steps}
    program = (*before, replace(step, repeat=steps, schedule=schedule))
    return seal(bundle.path, replace(bundle.manifest, program=program))


def test_the_schedule_leads_from_noise_to_actions(source: Bundle) -> None:
    prefix, step = source.manifest.program
    assert (prefix.graph, prefix.repeat) == ("prefix", 1)
    assert (step.graph, step.repeat) == ("step", 10)
    t, dt = (np.array(step.schedule[name]) for name in ("t", "dt"))
    assert t[0] == 1
    np.testing.assert_allclose(t + dt, [*t[1:], 0], atol=1e-12)


def test_onnx_runtime_gives_the_actions_of_torch(
    source: Bundle, exported: Bundle, observations: list[dict[str, Any]]
) -> None:
    graphs, modules = load(exported.path, seed=3), torch_policy(source, seed=3)
    for observation in observations:
        wanted = modules.infer(observation).chunk
        np.testing.assert_allclose(graphs.infer(observation).chunk, wanted, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("steps", [1, 4])
def test_the_number_of_steps_is_a_matter_of_the_schedule_alone(
    steps: int,
    source: Bundle,
    exported: Bundle,
    copied: Callable[[Bundle], Bundle],
    observations: list[dict[str, Any]],
) -> None:
    policy = Policy.open(with_steps(copied(exported), steps))
    noise = np.random.default_rng(5).standard_normal((1, 8, 4), np.float32)
    given = policy.infer(observations[0], noise={"x": noise}).chunk
    np.testing.assert_allclose(given, by_hand(source, observations[0], noise, steps), rtol=1e-3, atol=1e-5)


def by_hand(source: Bundle, observation: dict[str, Any], noise: np.ndarray, steps: int) -> np.ndarray:
    """Take Euler steps with the torch modules, normalising and restoring as the sample's statistics say."""
    modules = load_modules(source)
    statistics = json.loads((FLOW / "statistics.json").read_text())
    words = json.loads((FLOW / "vocabulary.json").read_text())["words"]
    mean, deviation = (np.array(statistics["proprio"][name], np.float32) for name in ("mean", "std"))
    ids = [words[word] for word in str(observation["instruction"]).split()]
    with torch.inference_mode():
        context = modules["prefix"](
            torch.from_numpy(observation["image"]).reshape(1, 96, 96, 3),
            torch.from_numpy((observation["proprio"].reshape(1, 4) - mean) / deviation).float(),
            torch.tensor([ids + [0] * (8 - len(ids))]),
        )
        x = torch.from_numpy(noise)
        for turn in range(steps):
            t, dt = torch.tensor([1.0 - turn / steps]), torch.tensor([-1.0 / steps])
            x = x + dt * modules["step"].velocity(x, t, context)
    mean, deviation = (np.array(statistics["action"][name], np.float32) for name in ("mean", "std"))
    return (x.numpy() * deviation + mean)[0]


def test_one_exact_step_leads_back_to_the_actions(imported: Imported) -> None:
    torch.manual_seed(0)
    actions = torch.randn(6, 8, 4)
    x, t, velocity = imported.learning.draw_flow(actions, 3)
    assert x.shape == velocity.shape == (6, 3, 8, 4)
    assert ((t > 0) & (t <= 1)).all()
    torch.testing.assert_close(x - t[..., None, None] * velocity, actions[:, None].expand_as(x))


def test_the_prefix_starts_with_the_trunk_of_vla_metaworld(imported: Imported) -> None:
    from safetensors.torch import load_file

    learner = imported.learning.FlowLearner(0, imported.Budget(10, 1), METAWORLD)
    trunk = load_file(METAWORLD / "weights.safetensors")
    state = learner.policy.state_dict()
    shared = [name for name in trunk if f"prefix.{name}" in state]
    assert {name.split(".")[0] for name in shared} == {"vision", "language", "proprio", "fusion"}
    assert all(torch.equal(state[f"prefix.{name}"], trunk[name].float()) for name in shared)


def test_an_interrupted_training_ends_with_the_same_weights(
    imported: Imported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(imported.learning, "BATCH", 2)
    monkeypatch.setattr(imported.learning, "CHECKPOINT_EVERY", 2)
    monkeypatch.setattr(sys.modules["policy"], "TRUNK_DEPTH", 1)
    monkeypatch.setattr(sys.modules["policy"], "EXPERT_DEPTH", 1)
    whole = train(imported, tmp_path / "whole.pt", until=1.0)
    train(imported, tmp_path / "cut.pt", until=0.75)
    resumed = train(imported, tmp_path / "cut.pt", until=1.0)
    assert resumed.keys() == whole.keys()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)


def train(imported: Imported, checkpoint: Path, until: float) -> dict[str, torch.Tensor]:
    """Train for up to four steps; what a checkpoint missed is trained again."""
    random = np.random.default_rng(1)
    frames = imported.Frames(
        random.integers(256, size=(4, 96, 96, 3), dtype=np.uint8),
        random.random((4, 4), np.float32),
        random.random((4, 8, 4), np.float32),
        np.arange(4),
        np.arange(4),
    )
    learner = imported.learning.FlowLearner(0, imported.Budget(4, float("inf")), METAWORLD)
    batches = imported.Batches.read(frames, FLOW, 0)
    state = learner.resume(checkpoint)
    if state is not None:
        batches.restore(state)
    learner.train(batches, until, lambda *_: None, checkpoint)
    return dict(learner.average.state_dict())


@pytest.mark.parametrize("name", ["environment.py", "vocabulary.json", "statistics.json"])
def test_what_must_be_beside_a_policy_is_that_of_vla_metaworld(name: str) -> None:
    assert (FLOW / name).read_bytes() == (METAWORLD / name).read_bytes()


def test_the_folder_stays_small() -> None:
    assert sum(file.stat().st_size for file in FLOW.iterdir() if file.is_file()) <= 16_000_000


@pytest.mark.parametrize("folder", small_or_full([METAWORLD], [FLOW, METAWORLD]), ids=lambda folder: folder.name)
@pytest.mark.parametrize("script", small_or_full(["train.py"], ["train.py", "evaluate.py"]))
def test_the_scripts_find_what_the_folders_share(folder: Path, script: str) -> None:
    done = subprocess.run(
        [sys.executable, folder / script, "--help"], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "--threads" in done.stdout
