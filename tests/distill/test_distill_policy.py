"""Distillation: a pruned policy learns what the whole one does, from recordings and episodes, without an expert."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.distill.policy import PolicyDistillation
from vlatool.episodes.play import EVALUATION_SEEDS
from vlatool.errors import DataError, OutputError, RecipeError, SourceError
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.export.onnx import ExportOnnx
from vlatool.machine.host import cache_directory
from vlatool.module.edits import read_edits
from vlatool.module.torch_policy import torch_policy, unedited_modules
from vlatool.prune.neurons import Neurons
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.loop import Trainer
from vlatool.training.teacher import Teacher

SHORT = {
    "steps": 12,
    "batch": 4,
    "episodes": 4,
    "student_episodes": 2,
    "every": 5,
    "learning_rate": 0.003,
    "threads": 1,
}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def pruned(source_bundle: Bundle, tmp_path: Path) -> Bundle:
    return run_transform(Neurons(ratio=0.7), source_bundle, tmp_path / "pruned", Context()).bundle


def error(bundle: Bundle, whole: Bundle) -> float:
    ours, theirs = torch_policy(bundle, 0), torch_policy(whole, 0)
    observations = recorded_observations(whole, 16)
    return float(np.mean([relative_error(ours.infer(each).chunk, theirs.infer(each).chunk) for each in observations]))


def distilled(source: Bundle, out: Path, told: list[str] | None = None, **options: object) -> Bundle:
    context = Context() if told is None else Context(lambda what, _share: told.append(what))
    return run_transform(build_stage("distill.policy", {**SHORT, **options}), source, out, context).bundle


def test_it_recovers_what_pruning_lost(pruned: Bundle, source_bundle: Bundle, tmp_path: Path):
    made = distilled(pruned, tmp_path / "out", steps=60, batch=16, average=0.9, episodes=0, student_episodes=0)
    assert error(made, source_bundle) < 0.5 * error(pruned, source_bundle)
    assert read_edits(made) == read_edits(pruned)
    assert [step["stage"] for step in made.manifest.build[-2:]] == ["prune.neurons", "distill.policy"]


def test_teacher_and_student_play_and_the_result_is_exported_and_made_again(
    pruned: Bundle, policy_template: Path, tmp_path: Path
):
    told: list[str] = []
    made = distilled(pruned, tmp_path / "out", told)
    assert [line for line in told if "plays" in line] == [
        "the teacher plays 4 episodes", "the student plays 2 episodes", "the student plays 2 episodes",
    ]  # fmt: skip
    assert not list((cache_directory() / "streams").glob("*/*")), "nothing is left"
    training = json.loads((made.path / "module/training.json").read_text())
    assert [(each["step"], each["actor"], each["episodes"]) for each in training["rounds"]] == [
        (0, "teacher", 4), (5, "student", 2), (10, "student", 2),
    ]  # fmt: skip
    assert len(training["losses"]) == 12
    first, second, *_ = PolicyDistillation(**SHORT).summarize(made)
    assert first.startswith("l1 ")
    assert " in 12 steps on " in first
    assert second.startswith("episodes that succeeded, with noise: teacher ")
    exported = run_transform(ExportOnnx(), made, tmp_path / "onnx", Context()).bundle
    assert load(exported.path).infer(recorded_observations(exported, 1)[0]).chunk.shape == (4, 2)
    assert rebuild(exported, Context(), source=str(policy_template), cache=tmp_path / "cache").identical


def test_a_run_that_is_killed_goes_on_to_the_same_weights(
    pruned: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole = distilled(pruned, tmp_path / "whole")
    dies_at = [0, 3, 6, 11, -1]

    class Killed(BaseException):
        pass

    def dying(self, until, draw, tell):
        def told(step: int, loss: float) -> None:
            tell(step, loss)
            if step - 1 == dies_at[0]:
                raise Killed

        train(self, until, draw, told)

    train = Trainer.train
    monkeypatch.setattr(Trainer, "train", dying)
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
    stage = build_stage("distill.policy", SHORT)
    while len(dies_at) > 1:
        with pytest.raises(Killed):
            run_transform(stage, pruned, tmp_path / "out", Context())
        assert not (tmp_path / "out").exists()
        dies_at.pop(0)
    made = run_transform(stage, pruned, tmp_path / "out", Context()).bundle
    name = "module/main.safetensors"
    assert made.manifest.files[name].sha256 == whole.manifest.files[name].sha256


@pytest.mark.parametrize(("options", "says"), [
    ({"loss": "hubert"}, r"Unknown loss 'hubert'; did you mean 'huber'"),
    ({"loss": "kl"}, "kl compares discrete actions"),
])  # fmt: skip
def test_a_loss_that_does_not_fit_is_refused(pruned: Bundle, tmp_path: Path, options: dict[str, str], says: str):
    with pytest.raises(RecipeError, match=says):
        distilled(pruned, tmp_path / "out", **options)


def test_a_teacher_that_does_something_else_is_refused(source_bundle: Bundle, policy_dir: Path, tmp_path: Path):
    text = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(text.replace("[dx, dy]", "[dy, dx]"))
    other = run_transform(TorchModule(policy=policy_dir), None, tmp_path / "other", Context()).bundle
    with pytest.raises(RecipeError, match="The teacher gives 'action' as "):
        distilled(source_bundle, tmp_path / "out", teacher=str(other.path))
    assert torch.get_num_threads() >= 1


def test_a_teacher_that_is_exported_is_refused(source_bundle: Bundle, float_bundle: Bundle, tmp_path: Path):
    with pytest.raises(RecipeError, match="has no torch modules that could teach"):
        distilled(source_bundle, tmp_path / "out", teacher=str(float_bundle.path))


def test_without_recordings_and_episodes_there_is_nothing_to_learn_from(policy_dir: Path, tmp_path: Path):
    (policy_dir / "calibration.npz").unlink()
    (policy_dir / "evaluation.npz").unlink(missing_ok=True)
    source = run_transform(TorchModule(policy=policy_dir), None, tmp_path / "source", Context()).bundle
    with pytest.raises(DataError, match="no observations to train on"):
        distilled(run_transform(Neurons(), source, tmp_path / "pruned", Context()).bundle, tmp_path / "out", episodes=0)


def test_a_policy_that_was_not_changed_has_no_teacher(source_bundle: Bundle, tmp_path: Path):
    with pytest.raises(RecipeError, match="it would be its own teacher"):
        distilled(source_bundle, tmp_path / "out")


def test_the_student_is_not_its_own_teacher(pruned: Bundle, tmp_path: Path):
    with pytest.raises(RecipeError, match="is the student itself"):
        distilled(pruned, tmp_path / "out", teacher=str(pruned.path))


@pytest.mark.parametrize(("first", "says"), [
    (4_999_998, r"take the seeds 4999998 to 500\d+; evaluations begin at 5000000"),
    (EVALUATION_SEEDS, r"take the seeds 5000000 to 500\d+; evaluations begin at 5000000"),
    (6_000_000, r"take the seeds 6000000 to 600\d+; evaluations begin at 5000000"),
])  # fmt: skip
def test_episodes_to_train_on_are_not_those_of_evaluations(pruned: Bundle, tmp_path: Path, first: int, says: str):
    with pytest.raises(RecipeError, match=says):
        distilled(pruned, tmp_path / "out", first_seed=first)


def test_episodes_up_to_the_evaluations_are_trained_on(pruned: Bundle):
    options = {"episodes": 10, "student_episodes": 0}
    build_stage("distill.policy", {**options, "first_seed": EVALUATION_SEEDS - 10}).check(pruned, None)
    with pytest.raises(RecipeError, match="evaluations begin at 5000000"):
        build_stage("distill.policy", {**options, "first_seed": EVALUATION_SEEDS - 9}).check(pruned, None)


def test_evaluations_begin_where_trainings_end():
    assert ClosedLoop().first_seed == EVALUATION_SEEDS


def changed_code(policy_dir: Path, old: str, new: str, place: Path) -> Bundle:
    """The tiny policy with other code, pruned."""
    code = (policy_dir / "policy.py").read_text()
    assert old in code
    (policy_dir / "policy.py").write_text(code.replace(old, new))
    source = run_transform(TorchModule(policy=policy_dir), None, place / "source", Context()).bundle
    return run_transform(Neurons(ratio=0.7), source, place / "pruned", Context()).bundle


def test_a_factory_that_gives_one_module_has_no_teacher(policy_dir: Path, tmp_path: Path):
    cached = "import functools\n\n\n@functools.cache\ndef make("
    with pytest.raises(SourceError, match="gives the same module each time"):
        changed_code(policy_dir, "def make(", cached, tmp_path)


def test_a_teacher_that_shares_weights_with_the_student_is_refused(pruned: Bundle, monkeypatch: pytest.MonkeyPatch):
    modules = unedited_modules(pruned)
    monkeypatch.setattr("vlatool.training.teacher.unedited_modules", lambda _source: modules)
    with pytest.raises(SourceError, match="gives the same module each time"):
        Teacher.of(pruned, None, modules)


def test_a_policy_without_gradients_is_refused(policy_dir: Path, tmp_path: Path):
    source = changed_code(policy_dir, "    def forward(", "    @torch.no_grad()\n    def forward(", tmp_path)
    with pytest.raises(SourceError, match="gives its action without gradients"):
        distilled(source, tmp_path / "out", episodes=0, student_episodes=0)


def test_what_was_trained_is_kept_until_the_bundle_is_written(
    pruned: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
    options = {"episodes": 0, "student_episodes": 0, "steps": 3}
    with monkeypatch.context() as patched:
        patched.setattr("vlatool.module.stage.write_module", full)
        with pytest.raises(OutputError):
            distilled(pruned, tmp_path / "out", **options)
    told: list[str] = []
    distilled(pruned, tmp_path / "out", told, **options)
    assert not [line for line in told if line.startswith("step ")], "no step is taken again"
    assert not list((cache_directory() / "streams").glob("*/*")), "nothing is left"


def test_the_class_is_the_stage():
    assert PolicyDistillation.name() == "distill.policy"
