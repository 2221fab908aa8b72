"""Policies that keep values are trained on windows of episodes, and compared with their teacher over whole ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _full import full, small_or_full
from _recurrent import BATCHES, ENVIRONMENT, LENGTH, recorded, recurrent_bundle
from _trainings import Killed, digest, distilled, killed_after, raise_killed, training_of

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, RecipeError, SourceError
from vlatool.module.batched_program import BatchedProgram
from vlatool.module.torch_policy import torch_policy
from vlatool.report import read_report
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.report import along_lines

pytestmark = pytest.mark.usefixtures("in_this_process")
LEARNS = {"steps": 400, "batch": 96, "window": 6, "learning_rate": 0.01, "average": 0.9}
"""Enough to learn what to remember."""
FEW = {"steps": 9, "batch": 24, "window": 4}
WORLD = """\
import numpy as np


class World:
    def reset(self, *, seed=None):
        self.random, self.steps = np.random.default_rng(seed), 0
        return self.seen(), {}

    def seen(self):
        return {"target": self.random.uniform(-1, 1, 2).astype(np.float32)}

    def step(self, action):
        self.steps += 1
        return self.seen(), 0.0, False, self.steps == 12, {"success": self.steps == 12}


def make(task):
    return World()
"""
TRAIN = """\
import numpy as np


def batches(seed, size):
    random, row = np.random.default_rng(seed), 0
    while True:
        rows = np.arange(row, row + size)
        row += size
        yield {"target": random.uniform(-1, 1, (size, 2)), "episode": rows // 12}
"""


def pair(
    place: Path, student: str = "elman", teacher: str = "delayed", **options: Any
) -> tuple[Bundle, dict[str, str]]:
    """A student, and what names its teacher."""
    taught = recurrent_bundle(place / "student", student, **options)
    return taught, {"teacher": str(recurrent_bundle(place / "teacher", teacher, **options).path)}


def apart(student: Bundle, teacher: Bundle) -> float:
    """How far their actions are from each other in new episodes, as a share of the teacher's."""
    policies = torch_policy(student, 0), torch_policy(teacher, 0)
    rows, chunks = recorded(10, seed=7), ([], [])
    for target, begins in zip(rows["target"], np.diff(rows["episode"], prepend=-1), strict=True):
        for policy, own in zip(policies, chunks, strict=True):
            if begins:
                policy.reset()
            own.append(policy.infer({"target": target}).chunk)
    ours, theirs = map(np.stack, chunks)
    return float(np.abs(ours - theirs).mean() / np.abs(theirs).mean())


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> tuple[Bundle, Bundle, Bundle]:
    """A student before and after its training, and its teacher."""
    place = tmp_path_factory.mktemp("learnt")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VLATOOL_CACHE", str(place / "cache"))
        patch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
        source, named = pair(place, count=60)
        made = distilled(source, place / "out", **{**LEARNS, **named})
    return source, made, Bundle.open(named["teacher"])


def test_a_student_learns_to_remember(learnt: tuple[Bundle, Bundle, Bundle]):
    source, made, teacher = learnt
    assert apart(source, teacher) > 0.9
    assert apart(made, teacher) < 0.25


def test_the_report_compares_whole_episodes(learnt: tuple[Bundle, Bundle, Bundle]):
    source, made, teacher = learnt
    about = training_of(made)["along"]
    assert about["episodes"] == 30, "half of the recording calibrates, the other half evaluates"
    assert about["observations"] == 30 * LENGTH
    scale = np.abs(recorded(60)["action"]).mean()
    assert about["before"] / scale == pytest.approx(apart(source, teacher), rel=0.3)
    assert about["after"] / scale == pytest.approx(apart(made, teacher), rel=0.5)
    said = f"l1 {about['before']:.4g} -> {about['after']:.4g} over 360 observations of 30 whole episodes"
    stage = build_stage("distill.policy", {})
    assert any(line.startswith(said) for line in stage.summarize(made))
    assert read_report(made.path / "reports").summary[0].startswith(said)


def test_without_what_is_kept_it_learns_nothing(tmp_path: Path, learnt: Any, monkeypatch: pytest.MonkeyPatch):
    """The control: the same training, whose student forgets before each step."""
    monkeypatch.setattr(BatchedProgram, "kept_of", lambda *_: {})
    source, named = pair(tmp_path, count=60)
    made = distilled(source, tmp_path / "out", **{**LEARNS, **named})
    assert apart(made, learnt[2]) > 0.8


def test_windows_that_begin_at_zero_lose_what_was_remembered_and_the_command_says_so(
    tmp_path: Path, learnt: tuple[Bundle, Bundle, Bundle]
):
    """Each row as if it were the first of its episode; the student that knew better forgets."""
    _, made, teacher = learnt
    alone = {**LEARNS, "steps": 150, "loss": "l2", "window": 1, "burn_in": 0, "teacher": str(teacher.path)}
    forgetful = distilled(made, tmp_path / "out", **alone)
    assert apart(forgetful, teacher) > 2 * apart(made, teacher)
    stage = build_stage("distill.policy", {})
    (said,) = [line for line in stage.summarize(forgetful) if line.startswith("warning")]
    assert "over whole episodes it is further from its teacher than before the training" in said
    assert said.endswith("(--burn-in 0): leave --burn-in out")
    assert said in read_report(forgetful.path / "reports").summary
    assert not [line for line in stage.summarize(made) if line.startswith("warning")]


@pytest.mark.parametrize(("after", "in_windows", "more", "wanted"), [
    (0.1, 0.09, {}, ()), (0.3, 0.1, {}, ("3.0 times as far", "take a longer --window")),
    (1.5, 1.5, {}, ("further", "take a longer --window")), (0.3, 0.1, {"burn_in": 4}, ("3.0 times", "--burn-in 4")),
])  # fmt: skip
def test_a_loss_in_windows_that_is_not_that_of_episodes_is_said(
    after: float, in_windows: float, more: dict[str, int], wanted: tuple[str, ...]
):
    along = {"episodes": 2, "observations": 24, "before": 1.0, "after": after, **more}
    lines = along_lines({"loss": "l1", "losses": [9.0] * 38 + [in_windows] * 2, "along": along})
    assert len(lines) == 1 + bool(wanted)
    assert all(part in lines[-1] for part in wanted)


@pytest.mark.parametrize("burn_in", small_or_full([0], [0, 2]))
def test_a_shorter_burn_in_is_enough_for_what_is_forgotten(tmp_path: Path, burn_in: int):
    source, named = pair(tmp_path, count=60)
    made = distilled(source, tmp_path / "out", **{**LEARNS, **named, "burn_in": burn_in})
    assert apart(made, Bundle.open(named["teacher"])) < 0.4


@pytest.mark.parametrize("options", [
    {}, {"accumulate": 3}, {"patience": 9}, {"control": "noise"},
    *small_or_full([], [{"alpha": 0.5}, {"alpha": 0.0, "label_share": 0.4}, {"burn_in": 3}]),
])  # fmt: skip
def test_a_run_that_is_killed_goes_on_to_the_same_bits(tmp_path: Path, options: dict[str, Any]):
    source, named = pair(tmp_path)
    whole = distilled(source, tmp_path / "whole", **{**FEW, **named, **options})
    for step in (2, 5) if full() or not options else (5,):
        with killed_after(step, raise_killed), pytest.raises(Killed):
            distilled(source, tmp_path / "killed", **{**FEW, **named, **options})
    killed = distilled(source, tmp_path / "killed", **{**FEW, **named, **options})
    assert digest(killed) == digest(whole)
    ours, theirs = training_of(killed), training_of(whole)
    assert ours == theirs
    if full() or not options:
        assert digest(killed) != digest(distilled(source, tmp_path / "seed", **{**FEW, **named, **options, "seed": 1}))


def test_parts_of_a_batch_give_the_same_training(tmp_path: Path):
    source, named = pair(tmp_path)
    curves = [
        np.array(
            training_of(distilled(source, tmp_path / str(parts), **{**FEW, **named, "accumulate": parts}))["losses"]
        )
        for parts in (1, 2, 6)
    ]
    assert np.abs(curves[1] / curves[0] - 1).max() < 1e-3
    assert np.abs(curves[2] / curves[0] - 1).max() < 1e-3


@pytest.mark.parametrize("student", ["again", "gru"])
def test_the_teacher_remembers_along_what_the_student_plays(tmp_path: Path, student: str):
    """Episodes of both, in an environment; the loss of a student that is its teacher is zero."""
    source, named = pair(tmp_path, student, count=0, more=ENVIRONMENT, code=WORLD)
    made = distilled(source, tmp_path / "out", **{**FEW, **named, "episodes": 4, "student_episodes": 3, "every": 3})
    training = training_of(made)
    assert [about["episodes"] for about in training["rounds"]] == [4, 3, 3]
    assert [about["observations"] for about in training["rounds"]] == [4 * LENGTH, 3 * LENGTH, 3 * LENGTH]
    if student == "again":
        assert max(training["losses"]) < 0.02
        assert training["along"]["before"] < 1e-6


def test_batches_number_their_episodes(tmp_path: Path):
    source, named = pair(tmp_path, count=0, more=BATCHES, code=TRAIN)
    made = distilled(source, tmp_path / "out", **{**FEW, **named, "from_batches": 30})
    (about,) = training_of(made)["rounds"]
    assert about["observations"] == 30
    assert training_of(made)["along"]["episodes"] == 3


@pytest.mark.parametrize(("episode", "message"), [
    ("", "has no 'episode', and the policy keeps values"),
    (', "episode": rows / 12', "'episode' in batch 1 of .* is float64"),
    (', "episode": [[1]] * size', "wanted a whole number for each row"),
])  # fmt: skip
def test_batches_that_do_not_are_refused(tmp_path: Path, episode: str, message: str):
    source, named = pair(tmp_path, count=0, more=BATCHES, code=TRAIN.replace(', "episode": rows // 12', episode))
    with pytest.raises(DataError, match=message):
        distilled(source, tmp_path / "out", **{**FEW, **named, "from_batches": 30})


@pytest.mark.parametrize(("options", "message"), [
    ({"processes": 2}, "which several processes do not share"),
    ({"targets": "flow"}, "--targets flow compares single inferences, and the policy keeps 'memory'"),
    ({"features": 1.0}, "--features compares single inferences"),
    ({"attention": 1.0}, "--attention compares single inferences"),
    ({"batch": 8, "window": 9}, "holds 0 windows of 9; wanted 1"),
    ({"batch": 20, "window": 9, "accumulate": 3}, "holds 2 windows of 9; wanted 3"),
])  # fmt: skip
def test_what_windows_are_not_made_for_is_refused(tmp_path: Path, options: dict[str, Any], message: str):
    source, named = pair(tmp_path)
    with pytest.raises(RecipeError, match=message) as caught:
        build_stage("distill.policy", {**named, **options}).check(source, None)
    assert caught.value.fix


def test_windows_of_a_policy_that_keeps_nothing_are_refused(source_bundle: Bundle):
    for options, name in (({"window": 8}, "--window"), ({"burn_in": 0}, "--burn-in")):
        with pytest.raises(RecipeError, match=f"{name} is of policies that keep values"):
            build_stage("quantize.qat", options).check(source_bundle, None)


@pytest.mark.parametrize(("recording", "options", "message"), [
    ({"episodes": False}, {}, "does not say where episodes begin"),
    ({"count": 2}, {"patience": 1}, r"too few episodes to hold whole ones out"),
    ({"count": 1, "length": 30}, {}, r"too few episodes to hold whole ones out \(1\)"),
])  # fmt: skip
def test_recordings_without_whole_episodes_are_refused(tmp_path: Path, recording: Any, options: Any, message: str):
    long = recording.pop("length", 0)
    source, named = pair(tmp_path, **recording) if not long else one_episode(tmp_path)
    with pytest.raises(DataError, match=message) as caught:
        distilled(source, tmp_path / "out", **{**FEW, **named, **options})
    assert "record" in caught.value.fix


def one_episode(place: Path) -> tuple[Bundle, dict[str, str]]:
    """A recording of one long episode, of which no half is whole episodes."""
    from _recurrent import write_recurrent

    from vlatool.sources.torch_module import TorchModule
    from vlatool.user_code import trust

    made = []
    for kind in ("elman", "delayed"):
        folder = write_recurrent(place / kind, kind, count=3)
        rows = recorded(3)
        np.savez(folder / "calibration.npz", **{**rows, "episode": np.zeros(len(rows["episode"]), int)})
        trust.allow(folder)
        made.append(run_transform(TorchModule(policy=folder), None, place / f"{kind}-source", Context()).bundle)
    return made[0], {"teacher": str(made[1].path)}


def test_a_student_that_keeps_nothing_learns_what_its_teacher_did_in_episodes(tmp_path: Path, source_bundle: Bundle):
    """The labels are those of a teacher that remembers; what depends on them alone cannot be learnt."""
    source, named = pair(tmp_path, student="plain", count=20)
    made = distilled(source, tmp_path / "out", **{"steps": 3, **named})
    assert "along" not in training_of(made)
    frames = json.loads((made.path / "module/training.json").read_text())
    assert frames["losses"][0] == pytest.approx(float(np.abs(recorded(20)["action"]).mean()), rel=0.3)


def test_qat_trains_along_episodes_and_calibrates_on_some(tmp_path: Path):
    source = recurrent_bundle(tmp_path / "delayed", "delayed", count=20)
    stage = build_stage("quantize.qat", {**FEW, "learning_rate": 1e-4})
    made = run_transform(stage, source, tmp_path / "qat", Context()).bundle
    assert training_of(made)["along"]["after"] < 0.02
    with np.load(made.path / "data/played.npz") as played:
        assert len(played["target"]) == 120
        assert np.flatnonzero(played["(begins)"]).tolist() == list(range(0, 120, LENGTH))


@pytest.mark.parametrize("stage", ["quantize.qat", "prune.structured", "prune.magnitude"])
def test_a_state_that_is_not_declared_is_refused_before_anything_is_changed(stage: str, tmp_path: Path):
    """A trace would hold for ever what it was, and a training would learn nothing of it."""
    source = recurrent_bundle(tmp_path / "hiding", "hiding", count=4)
    with pytest.raises(SourceError, match=r"would forget: forward\(\) changes 'before' from call") as caught:
        run_transform(build_stage(stage, {}), source, tmp_path / "out", Context())
    assert "declare it with 'keep'" in caught.value.fix
    assert not (tmp_path / "out").exists()
