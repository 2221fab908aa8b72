"""Proof that the teacher matters: an expert's share of the loss, the teacher's of the gradient, and controls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _full import small_or_full
from _trainings import Killed, digest, distilled, killed_after, raise_killed, training_of
from safetensors.numpy import load_file

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.data import recorded_observations
from vlatool.distill.policy import PolicyDistillation
from vlatool.errors import DataError, RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.torch_policy import torch_policy
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context
from vlatool.stage.controls import controls
from vlatool.stage.run import run_transform
from vlatool.training.batches import Batches

pytestmark = pytest.mark.usefixtures("in_this_process")
LONG = {"steps": 60, "batch": 16, "average": 0.9, "threads": 1}
TOLERANCE = 1e-3
"""As between one process and two that a teacher teaches alone."""


def error(made: Bundle, whole: Bundle) -> float:
    """How far a student is from the whole policy, on observations that it was trained on and on others."""
    ours, theirs = torch_policy(made, 0), torch_policy(whole, 0)
    seen = [*recorded_observations(whole, 16), *recorded_observations(whole, 16, whole.path / "data/evaluation.npz")]
    return float(np.mean([relative_error(ours.infer(each).chunk, theirs.infer(each).chunk) for each in seen]))


def weights(made: Bundle) -> np.ndarray:
    stored = sorted(load_file(made.path / "module/main.safetensors").items())
    return np.concatenate([value.ravel() for _, value in stored])


def test_the_shares_of_the_gradient_are_told_everywhere(
    pruned_once: Bundle, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    made = distilled(pruned_once, tmp_path / "out", alpha=0.5, label_share=0.25)
    training = training_of(made)
    about = training["teacher"]
    assert training["loss"] == "0.5 l1 + 0.5 expert"
    assert [look["step"] for look in about["gradients"]] == [1, 7, 12], "after 5, 50 and 95 % of 12 steps"
    assert all(look["teacher"] > 0 and look["expert"] > 0 for look in about["gradients"])
    shares = [look["teacher"] / (look["teacher"] + look["expert"]) for look in about["gradients"]]
    assert [look["share"] for look in about["gradients"]] == pytest.approx(shares)
    assert about["gradient_share"] == pytest.approx(np.mean(shares))
    assert about["labels"] == {"used": 6, "recorded": 24}
    words = f"{100 * shares[0]:.0f} % in step 1, {100 * shares[1]:.0f} % in step 7, {100 * shares[2]:.0f} % in step 12"
    said = f"gradient from the teacher: {words} (alpha 0.5; 6 of 24 recorded observations with the expert's action)"
    assert said in PolicyDistillation(alpha=0.5).summarize(made)
    page, text = ((made.path / "reports" / name).read_text() for name in ("report.html", "report.md"))
    assert words in page.replace("&#39;", "'")
    assert words in text


def test_without_an_expert_the_teacher_has_all_of_it(pruned_once: Bundle, tmp_path: Path):
    made = distilled(pruned_once, tmp_path / "out", steps=2)
    assert training_of(made)["teacher"] == {"alpha": 1.0, "gradient_share": 1.0}
    assert "gradient from the teacher: 100 % (alpha 1, the loss has no other term)" in PolicyDistillation().summarize(
        made
    )
    assert "100 % (alpha 1" in (made.path / "reports/report.html").read_text()


def test_with_alpha_0_nobody_asks_the_teacher(pruned_once: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not even when it stops getting better, and nobody plays although episodes have defaults."""
    for function in ("write_labels", "run_jobs"):
        monkeypatch.setattr(f"vlatool.training.session.{function}", lambda *_: pytest.fail("the teacher was asked"))
    made = distilled(pruned_once, tmp_path / "out", alpha=0, patience=5, episodes=1200, student_episodes=300)
    training = training_of(made)
    assert training["loss"] == "expert"
    assert training["teacher"] == {"alpha": 0.0, "gradient_share": 0.0, "labels": {"used": 20, "recorded": 20}}
    assert training["rounds"] == [{"step": 0, "actor": "expert", "observations": 20}]
    assert training["judged"]["scores"] == sorted(training["judged"]["scores"], reverse=True)
    (line,) = (line for line in PolicyDistillation().summarize(made) if "gradient" in line)
    assert line.startswith("gradient from the teacher: 0 % (alpha 0, the teacher was not asked; 20 of 20 recorded")


def test_the_teacher_s_batches_are_those_without_an_expert(
    pruned_once: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    drawn: dict[str, list[bytes]] = {"alone": [], "both": []}
    own, name = Batches._loss, "alone"

    def noting(self, rows):
        if "teacher.action" in self._frames.batch(rows):
            drawn[name].append(rows.tobytes())
        return own(self, rows)

    monkeypatch.setattr(Batches, "_loss", noting)
    distilled(pruned_once, tmp_path / "alone")
    name = "both"
    distilled(pruned_once, tmp_path / "both", alpha=0.5)
    assert len(drawn["alone"]) == 12
    assert drawn["both"] == drawn["alone"]


def test_an_expert_alone_teaches_what_it_did(pruned_once: Bundle, source_bundle: Bundle, tmp_path: Path):
    """The tiny policy's expert is the policy with a trembling hand, so that the student comes near it, too."""
    made = distilled(pruned_once, tmp_path / "out", alpha=0, **LONG)
    assert error(made, source_bundle) < 0.5 * error(pruned_once, source_bundle)


def test_where_labels_are_few_the_teacher_makes_the_difference(
    pruned_once: Bundle, source_bundle: Bundle, tmp_path: Path
):
    """Two labels of 24 (10 %), all observations: with the teacher, and the same student without it."""
    few = {**LONG, "label_share": 0.1}
    errors = [error(distilled(pruned_once, tmp_path / str(alpha), alpha=alpha, **few), source_bundle)
              for alpha in (0.5, 0)]  # fmt: skip
    assert errors[0] < 0.7 * errors[1]


def test_labels_of_other_observations_teach_nothing(pruned_once: Bundle, source_bundle: Bundle, tmp_path: Path):
    made = distilled(pruned_once, tmp_path / "noise", control="noise", **LONG)
    right = distilled(pruned_once, tmp_path / "right", **LONG)
    assert error(right, source_bundle) < 0.5 * error(made, source_bundle)
    assert training_of(made)["teacher"]["control"] == "noise"
    assert "control" not in training_of(right)["teacher"]


def test_a_control_is_never_handed_out_silently(
    pruned_once: Bundle, policy_template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    made = distilled(pruned_once, tmp_path / "out", control="noise", steps=2)
    assert any(line.startswith("a control, not for a robot") for line in PolicyDistillation().summarize(made))
    assert "a control, not for a robot" in (made.path / "reports/report.html").read_text()
    assert made.manifest.made_by["options"]["control"] == "noise"
    sentence = "a control, not for a robot: distill.policy was run with --control noise"
    with pytest.raises(SystemExit):
        main(["export", str(made.path), "-o", str(tmp_path / "onnx"), "--trust", str(policy_template)])
    assert sentence in capsys.readouterr().out
    exported = Bundle.open(tmp_path / "onnx")
    assert controls(exported) == (sentence,)
    with pytest.raises(SystemExit):
        main(["inspect", str(exported.path)])
    assert f"  CONTROL    {sentence}" in capsys.readouterr().out
    assert controls(run_transform(ExportOnnx(), pruned_once, tmp_path / "other", Context()).bundle) == ()


@pytest.mark.parametrize("options", [
    pytest.param({"alpha": 0.5, "label_share": 0.5, "patience": 9}, id="both and patience"),
    *small_or_full([], [pytest.param({"alpha": 0}, id="expert"), pytest.param({"control": "noise"}, id="noise")]),
])  # fmt: skip
def test_however_often_it_is_killed_it_goes_on_to_the_same_bundle(
    pruned_once: Bundle, tmp_path: Path, options: dict[str, float], monkeypatch: pytest.MonkeyPatch
):
    whole = distilled(pruned_once, tmp_path / "whole", **options)
    settings = PolicyDistillation.settings
    monkeypatch.setattr(PolicyDistillation, "settings", lambda self: replace(settings(self), checkpoint_s=0.0))
    for step in (1, 4, 7, 8):
        with killed_after(step, raise_killed), pytest.raises(Killed):
            distilled(pruned_once, tmp_path / "out", **options)
    made = distilled(pruned_once, tmp_path / "out", **options)
    assert digest(made) == digest(whole)
    assert training_of(made) == training_of(whole)


@pytest.mark.parametrize("alpha", [0.5, 0])
def test_two_processes_train_as_one_does(pruned_once: Bundle, tmp_path: Path, alpha: float):
    one, two = (distilled(pruned_once, tmp_path / str(count), alpha=alpha, processes=count) for count in (1, 2))
    parts = distilled(pruned_once, tmp_path / "parts", alpha=alpha, accumulate=2, threads=1)
    curves = [np.array(training_of(made)["losses"]) for made in (one, two, parts)]
    assert float(np.abs(curves[1] / curves[0] - 1).max()) < TOLERANCE
    assert curves[1] == pytest.approx(curves[2], rel=1e-6)
    assert float(np.linalg.norm(weights(two) - weights(one)) / np.linalg.norm(weights(one))) < TOLERANCE
    shares = [training_of(made)["teacher"]["gradient_share"] for made in (one, two)]
    assert shares[1] == pytest.approx(shares[0], rel=1e-3)


def test_it_is_made_again_from_its_record(pruned_once: Bundle, policy_template: Path, tmp_path: Path):
    for options in ({"alpha": 0.25, "label_share": 0.5}, {"control": "noise"}):
        made = distilled(pruned_once, tmp_path / str(len(options)), threads=1, **options)
        assert rebuild(made, Context(), source=str(policy_template), cache=tmp_path / "cache").identical


def test_what_is_held_out_is_judged_by_both(pruned_once: Bundle, tmp_path: Path):
    """Where the student stays as it is, the held-out loss is a mixture of what teacher and expert alone say."""
    still = {"patience": 9, "learning_rate": 1e-12, "steps": 4}
    scores = [training_of(distilled(pruned_once, tmp_path / str(alpha), alpha=alpha, **still))["judged"]["scores"][0]
              for alpha in (1.0, 0.0, 0.25)]  # fmt: skip
    assert scores[2] == pytest.approx(0.25 * scores[0] + 0.75 * scores[1], rel=1e-5)
    assert scores[0] != pytest.approx(scores[1], rel=1e-3)


@pytest.mark.parametrize(("options", "says"), [
    ({"label_share": 0.1}, "--alpha 1 uses none of them"),
    ({"alpha": 0, "control": "noise"}, "with --alpha 0 it is not asked"),
    ({"alpha": 0, "student_episodes": 5}, "got --student-episodes 5"),
    ({"alpha": 0, "episodes": 5}, "got --episodes 5"),
])  # fmt: skip
def test_what_contradicts_itself_is_refused(pruned_once: Bundle, tmp_path: Path, options: dict[str, float], says: str):
    with pytest.raises(RecipeError, match=says):
        distilled(pruned_once, tmp_path / "out", **options)


def test_an_expert_that_is_nowhere_is_refused(source_bundle: Bundle):
    files = {name: record for name, record in source_bundle.manifest.files.items() if "calibration" not in name}
    bare = replace(source_bundle, manifest=replace(source_bundle.manifest, files=files))
    with pytest.raises(DataError, match=r"--alpha 0\.5 needs an expert's actions, and .* has no recording"):
        PolicyDistillation(alpha=0.5, student="width=0.5").check(bare, None)
