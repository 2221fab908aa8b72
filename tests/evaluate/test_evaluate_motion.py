"""Episodes of a point that is moved to a goal: what success does not show, motion and disturbances do."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests._reach import EAGER, GOOD, TREMBLES, bundle_of, folder_of
from vlatool.bundle.bundle import Bundle
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, RecipeError, UsageError
from vlatool.evaluate import _player
from vlatool.evaluate._sentences import sentences
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.evaluate.recorded import Recorded
from vlatool.hardware.profile import load_profile
from vlatool.report import Measurement, Report, Row
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import cached_measure
from vlatool.user_code import trust


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bundle]:
    """One bundle of each kind."""
    folder = tmp_path_factory.mktemp("reach")
    kinds = {"good": GOOD, "trembles": TREMBLES, "eager": EAGER}
    return {name: bundle_of(folder / name, kind) for name, kind in kinds.items()}


def evaluated(bundles: dict[str, Bundle], name: str, episodes: int = 24, **options: object) -> Report:
    baseline = bundles["good"]
    stage = ClosedLoop(policy=baseline.path.parent / "policy", baseline=baseline.path, episodes=episodes, **options)
    stage.check(bundles[name], None)
    return stage.run(bundles[name], Context())


@pytest.fixture(scope="module")
def trembling(bundles: dict[str, Bundle]) -> Report:
    """The good policy beside the one that trembles."""
    return evaluated(bundles, "trembles")


def test_a_policy_that_trembles_keeps_its_success_and_is_found_by_its_motion(trembling: Report):
    base, row = trembling.rows
    assert base.value("success") == row.value("success") == 1.0
    assert row.value("success_drop") == 0.0
    for name in (
        "jerk_ratio",
        "path_length_ratio",
        "action_rate_ratio",
        "spectral_arc_length_ratio",
    ):
        assert row.get(name).low > 1.05, name
        assert row.get(name).samples == 24
    assert row.value("task_time_ratio") == row.value("steps_ratio") == 1.0
    assert "most in near" in row.get("jerk_ratio").note, "it trembles as much where there is little to do"
    assert any(
        "Where both succeed, more than the baseline's: " in said and "jerk" in said for said in trembling.summary
    )
    (first, second) = row.details["against the baseline, by task"]
    assert {first["task"], second["task"]} == {"near", "far"}
    assert (first["baseline"], first["success"], first["drop"]) == (1.0, 1.0, 0.0)


def test_a_policy_beside_itself_moves_as_it_does(bundles: dict[str, Bundle]):
    row = evaluated(bundles, "good", 20).rows[-1]
    ratios = {item.name: (item.value, item.low, item.high) for item in row.measurements if item.name.endswith("_ratio")}
    assert {"task_time_ratio", "path_length_ratio", "jerk_ratio", "detour_ratio", "steps_ratio"} <= set(ratios)
    assert set(ratios.values()) == {(1.0, 1.0, 1.0)}


def test_a_row_alone_tells_how_it_moves(bundles: dict[str, Bundle]):
    (row,) = ClosedLoop(policy=bundles["good"].path.parent / "policy", episodes=10).run(bundles["good"], Context()).rows
    assert row.value("task_time") == pytest.approx(2.0)
    assert row.get("path_length").unit == "length"
    assert row.value("detour") == pytest.approx(1.0, abs=0.02)
    assert "gripper_flips" not in {item.name for item in row.measurements}


def test_the_numbers_survive_the_report(trembling: Report):
    again = Report.from_json(trembling.to_json())
    assert again.rows[-1].raw == trembling.rows[-1].raw
    assert "motion.jerk" in again.rows[-1].raw


def test_an_eager_policy_is_as_good_and_falls_to_late_observations(bundles: dict[str, Bundle]):
    report = evaluated(bundles, "eager", 10, disturb=("all",), strength=3.0)
    row = report.rows[-1]
    assert row.value("success_drop") == 0.0
    table = {record["disturbance"]: record for record in row.details["under disturbances"]}
    assert next(iter(table)) == "delay", "the worst comes first"
    assert set(table) == {"delay", "dropped_frames", "push"}
    assert table["delay"]["baseline"] > 0.9
    assert table["delay"]["drop"] > 0.5
    assert table["push"]["drop"] == 0.0
    assert row.get("success_disturbed").samples == 30
    assert "under delay" in " ".join(report.summary)
    assert sum(row.raw["disturbed.delay"]) < sum(row.raw["disturbed.delay, baseline"])


def test_disturbances_are_the_same_again_and_change_with_their_strength(bundles: dict[str, Bundle]):
    def path(strength: float) -> tuple[float, ...]:
        row = evaluated(bundles, "good", 6, disturb=("push", "dropped_frames"), strength=strength).rows[-1]
        return tuple(record["success"] for record in row.details["under disturbances"]), row.raw["disturbed.push"]

    assert path(1.0) == path(1.0)


IDLE = "under push, strength 1, all 6 episodes of .* went as without it, step for step"


@pytest.mark.parametrize(("change", "strength", "warned"), [
    (("def disturb(", "def disturb(self, *_):\n        pass\n\n    def earlier("), 1.0, True),
    (("", ""), 1.0, False), (("", ""), 0.0, False),
], ids=["does nothing", "pushes", "strength 0"])  # fmt: skip
def test_a_disturbance_that_changes_nothing_is_told(
    bundles: dict[str, Bundle], tmp_path: Path, change: tuple[str, str], strength: float, warned: bool
):
    """Otherwise a policy would seem to bear what it never met."""
    folder = Path(shutil.copytree(bundles["good"].path.parent / "policy", tmp_path / "policy"))
    code = (folder / "environment.py").read_text()
    assert change[0] in code
    (folder / "environment.py").write_text(code.replace(*change, 1) if change[0] else code)
    trust.allow(folder)
    stage = ClosedLoop(policy=folder, episodes=6, disturb=("push",), strength=strength)
    report = stage.run(bundles["good"], Context())
    told = " ".join(report.warnings)
    assert bool(re.search(IDLE, told)) == warned, told
    if not strength:
        assert report.rows[-1].value("success_disturbed") == 1.0


def test_disturbances_follow_each_other_with_commas_or_one_by_one(bundles: dict[str, Bundle]):
    for kinds in ("push, delay", ("push,delay",), ["push", "delay"]):
        row = evaluated(bundles, "good", 6, disturb=kinds).rows[-1]
        assert {record["disturbance"] for record in row.details["under disturbances"]} == {"push", "delay"}


@pytest.mark.parametrize(
    ("kinds", "says"),
    [(("pushh",), "There is no disturbance 'pushh'.*push"), (("",), "There is no"), ("push,,delay", "There is no")],
)
def test_an_unknown_disturbance_is_refused(bundles: dict[str, Bundle], kinds: object, says: str):
    with pytest.raises(UsageError, match=says):
        evaluated(bundles, "good", 2, disturb=kinds)


WRONG = {
    "words": ('disturbances = ("push",)', 'disturbances = "push"', "it must be a list of words"),
    "a number": ('disturbances = ("push",)', "disturbances = 5", "it must be a list of words"),
    "numbers": ('disturbances = ("push",)', "disturbances = (1, 2)", "it must be a list of words"),
    "no method": ("def disturb(", "def disturbed(", "has no disturb"),
    "another kind": ("raise ValueError(f", "pass; raise ValueError(f", "failed at seed|offers no|unknown"),
    "it raises": ("self.push = (strength, seed)", "raise RuntimeError('jammed')", "RuntimeError: jammed"),
}


@pytest.mark.parametrize("case", [name for name in WRONG if name != "another kind"])
def test_an_environment_that_offers_disturbances_wrongly_is_named(
    bundles: dict[str, Bundle], tmp_path: Path, case: str
):
    before, after, says = WRONG[case]
    folder = folder_of(tmp_path / "policy")
    file = folder / "environment.py"
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))
    stage = ClosedLoop(policy=folder, episodes=2, disturb=("all",))
    with pytest.raises(DataError, match=says):
        stage.run(bundles["good"], Context())


def test_an_environment_without_disturbances_has_those_of_the_evaluation(bundles: dict[str, Bundle], tmp_path: Path):
    folder = folder_of(tmp_path / "policy")
    file = folder / "environment.py"
    file.write_text(file.read_text().replace('disturbances = ("push",)', "pass").replace("def disturb(", "def other("))
    (row,) = ClosedLoop(policy=folder, episodes=2, disturb=("all",)).run(bundles["good"], Context()).rows
    assert {record["disturbance"] for record in row.details["under disturbances"]} == {"delay", "dropped_frames"}


def test_actions_come_as_late_as_a_board_takes(bundles: dict[str, Bundle]):
    stage = ClosedLoop(policy=bundles["good"].path.parent / "policy", episodes=4, latency_in_the_loop=True)
    assert ClosedLoop(episodes=4).on(load_profile("raspberry-pi-4")).board == ""
    on_board = stage.on(load_profile("raspberry-pi-4"))
    assert on_board.board == "raspberry-pi-4"
    report = on_board.run(bundles["good"], Context())
    late = report.rows[0].get("latency_in_the_loop", "predicted")
    assert late is not None
    assert late.where == "raspberry-pi-4"
    assert report.rows[0].value("success") == 1.0
    assert "predicted for raspberry-pi-4" in report.summary[-1]
    here = stage.run(bundles["good"], Context())
    assert here.rows[0].get("latency_in_the_loop").value > 0
    assert "measured here" in here.summary[-1]


def test_what_was_told_and_cannot_be_used_is_said(bundles: dict[str, Bundle], tmp_path: Path):
    folder = folder_of(tmp_path / "policy")
    file = folder / "environment.py"
    file.write_text(file.read_text().replace('{"position": self.at, "success"', '{"position": "here", "success"'))
    (row,) = ClosedLoop(policy=folder, episodes=2).run(bundles["good"], Context()).rows
    assert row.details["unmeasured"] == [
        {"what": "motion from info['position']", "why": "it is str and no number, or not a real one (2 of 2 episodes)"}
    ]
    assert {name for name in row.raw if name.startswith("motion.")} == {"motion.task_time", "motion.action_rate",
                                                                       "motion.reversals"}  # fmt: skip


def test_an_evaluation_with_motion_is_kept_and_found_again(bundles: dict[str, Bundle], tmp_path: Path):
    stage = ClosedLoop(policy=bundles["good"].path.parent / "policy", episodes=4)
    first = cached_measure(stage, bundles["trembles"], tmp_path, Context())
    again = cached_measure(stage, bundles["trembles"], tmp_path, Context())
    assert json.dumps(first.rows[0].raw) == json.dumps(again.rows[0].raw)
    assert isinstance(first.rows[0], Row)
    assert Recorded is not ClosedLoop


@pytest.mark.parametrize(("options", "says"), [
    ({"control": "constant", "latency_in_the_loop": True}, "--latency-in-the-loop is of inferences, and constant"),
    ({"control": "random", "latency_in_the_loop": True, "board": "raspberry-pi-4"}, "is of inferences, and random"),
    ({"board": "raspberry-pi-4"}, "--board says whose latency counts"), ({"strength": 2.0}, "--strength is of disturb"),
])  # fmt: skip
def test_an_option_that_would_do_nothing_is_refused(bundles: dict[str, Bundle], options: dict[str, object], says: str):
    with pytest.raises(UsageError, match=says):
        ClosedLoop(policy=bundles["good"].path.parent / "policy", **options).check(bundles["good"], None)


def test_an_episode_that_cannot_be_played_again_costs_its_picture_alone(
    bundles: dict[str, Bundle], monkeypatch: pytest.MonkeyPatch
):
    real = _player.run_jobs

    def run(bundle: Bundle, jobs: list[EpisodesJob], *more: Any, **named: Any):
        if jobs[0].show:
            raise DataError("the environment is gone")
        return real(bundle, jobs, *more, **named)

    monkeypatch.setattr(_player, "run_jobs", run)
    row = evaluated(bundles, "trembles", 4).rows[-1]
    assert row.value("success") == 1.0
    assert not any(name.startswith("episode.") for name in row.raw)


def ratio(name: str, value: float) -> Measurement:
    return Measurement(name, value, "x", low=value - 0.002, high=value + 0.002)


def test_a_ratio_that_would_be_printed_as_one_is_worth_no_sentence():
    row = Row(
        "int8", measurements=(ratio("path_length_ratio", 1.003), ratio("jerk_ratio", 1.04), ratio("steps_ratio", 1.004))
    )
    assert list(sentences([row], "")) == ["Where both succeed, more than the baseline's: jerk 1.04x."]


def under(*records: dict[str, object]) -> str:
    return " ".join(sentences([Row("int8", details={"under disturbances": list(records)})], ""))


def test_it_succeeds_least_only_where_it_loses():
    light: dict[str, object] = {"disturbance": "light", "strength": 1.0, "baseline": 0.6667, "success": 0.6667}
    same, better = {**light, "drop": 0.0}, {**light, "disturbance": "delay", "success": 0.7, "drop": -0.0333}
    assert under(same, better) == "Under no disturbance does it succeed less often than the baseline."
    worse = {**light, "disturbance": "push", "success": 0.6, "drop": 0.0667}
    said = "It loses most beside the baseline under push: 60.0% succeed, 6.67 points fewer than of the baseline."
    assert under(same, worse, better) == said
    assert under(light) == "It succeeds least under light: 66.7%."


def test_several_strengths_are_played_one_after_the_other(bundles: dict[str, Bundle]):
    report = evaluated(bundles, "eager", 6, disturb=("delay", "push"), strength="2,0,1,1")
    row = report.rows[-1]
    table = row.details["under disturbances"]
    assert [(line["disturbance"], line["strength"]) for line in table] == [
        (kind, strength) for kind in ("delay", "push") for strength in (0.0, 1.0, 2.0)
    ]
    undisturbed, *disturbed = (line["success"] for line in table if line["disturbance"] == "delay")
    assert undisturbed == row.value("success"), "strength 0 is no disturbance"
    assert max(disturbed) < undisturbed
    assert row.get("success_disturbed").samples == 36
    assert "under delay at strength " in " ".join(report.summary)
    alone = evaluated(bundles, "eager", 6, disturb=("delay",), strength=2.0).rows[-1]
    assert alone.raw["disturbed.delay"] == row.raw["disturbed.delay at 2"]


@pytest.mark.parametrize("strength", ["", "0.5,", "1,x", (), (-1.0,), (11.0,), (float("nan"),), (True,), "1;2", None])
def test_a_strength_that_is_none_is_refused(strength: object):
    with pytest.raises(RecipeError, match="strength"):
        build_stage("evaluate.closed_loop", {"strength": strength})
