"""Claims about how a candidate moves, its worst task and disturbances, on episodes that are made up."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _examined import found
from _full import small_or_full
from pydantic import ValidationError

from tests._reach import EAGER, TREMBLES, bundle_of
from vlatool.accuracy.disturbance_drops import with_disturbed
from vlatool.accuracy.success_comparison import Outcome, compare_success, success_row
from vlatool.gate.claims.disturbed import Disturbed
from vlatool.gate.claims.motion import Motion
from vlatool.gate.claims.task_time import TaskTime
from vlatool.gate.claims.worst_task import WorstTask
from vlatool.gate.config import Gate, read_gate
from vlatool.gate.files import gate_files
from vlatool.gate.run import run_gate
from vlatool.report import Row
from vlatool.stage.base import Context

TASKS = ("open", "close", "press")


def played(
    seed: int, count: int, jerk: float = 1.0, time: float = 1.0, lost: dict[str, float] | None = None, own: bool = True
) -> list[Outcome]:
    """``count`` episodes; the scene of an episode, and what each policy makes of it, vary."""
    outcomes = []
    for number in range(count):
        task = TASKS[number % 3]
        scene = np.random.default_rng((7, number)).lognormal(0, 0.4)
        chance = np.random.default_rng((seed, number, 5))
        steps = max(2, round(60 * scene * time * chance.lognormal(0, 0.03)))
        rough = {"path_length": scene, "jerk": jerk * 50 * scene * chance.lognormal(0, 0.05), "task_time": steps / 20}
        success = bool(chance.random() > (lost or {}).get(task, 0.02))
        outcomes.append(Outcome(task, number, success, steps, "", rough if own else {"task_time": steps / 20}))
    return outcomes


def episodes(one: list[Outcome], two: list[Outcome], **under: tuple[list[Outcome], list[Outcome]]) -> Any:
    base = success_row("baseline", "baseline", one)
    row = compare_success(base, success_row("subject", "subject", two))
    if under:
        own, reference = ({(kind, 1.0): pair[place] for kind, pair in under.items()} for place in (1, 0))
        row = with_disturbed(row, own, reference)
    return base, row


@pytest.mark.parametrize(("jerk", "verdict"), [(1.0, "pass"), (1.05, "pass"), (1.3, "fail"), (1.1, "inconclusive")])
def test_rougher_motion_fails(jerk: float, verdict: str):
    result = found(Motion(margin=0.1), episodes=episodes(played(1, 300), played(2, 300, jerk=jerk)))
    assert result.verdict == verdict, result.sentence
    assert result.claim == "motion"
    assert "allowed: +10.0%" in result.sentence
    if verdict == "fail":
        assert re.search(
            r"^jerk \+\d\d\.\d% \(\+\d\d\.\d% to \+\d\d\.\d%\), most in ", result.sentence.replace("; ", ", ")
        )
        assert "path" not in result.sentence, "only what fails is told"


def test_what_is_undecided_says_how_many_episodes_would_decide():
    claim = Motion(margin=0.03)
    result = found(claim, episodes=episodes(played(1, 20), played(2, 20, jerk=1.01)))
    assert result.verdict == "inconclusive", result.sentence
    (count,) = re.findall(r"common successes; allowed: \+3.0%; about ([\d,]+) would decide", result.sentence)
    wanted = int(count.replace(",", ""))
    assert wanted > 20
    more = 9 * wanted  # the estimate is as rough as the ratio that it rests on
    assert found(claim, episodes=episodes(played(1, more), played(2, more, jerk=1.01))).verdict == "pass"
    few = found(Motion(), episodes=episodes(played(1, 5), played(2, 5)))
    assert "would decide" not in few.sentence, "without an interval nobody knows"


def test_honest_candidates_are_not_called_rougher():
    verdicts = [
        found(Motion(margin=0.0), episodes=episodes(played(10 + trial, 150), played(500 + trial, 150))).verdict
        for trial in range(small_or_full(30, 200))
    ]
    assert verdicts.count("fail") <= small_or_full(2, 6), "1 % are expected"


def test_metrics_that_are_named_count_and_must_be_known():
    rough = episodes(played(1, 120), played(2, 120, jerk=1.5))
    assert found(Motion(metrics=("path_length",), margin=0.1), episodes=rough).verdict == "pass"
    result = found(Motion(metrics=("path_length", "gripper_flips"), margin=0.1), episodes=rough)
    assert (result.verdict, "no ratio of gripper_flips (not told" in result.sentence) == ("inconclusive", True)
    with pytest.raises(ValidationError, match=r"no metric of motion jitter; allowed: .*jerk"):
        Motion(metrics=("jitter",))


@pytest.mark.parametrize(("runs_into", "verdict", "says"), [
    (0, "pass", "collisions 0 in all 60 common successes of both"),
    (3, "inconclusive", "collisions in 3 of 60 common successes, in none of the baseline's"),
    (9, "fail", "collisions in 9 of 60 common successes, in none of the baseline's"),
])  # fmt: skip
def test_collisions_where_the_baseline_has_none_decide(runs_into: int, verdict: str, says: str):
    base = [Outcome("open", seed, True, 20, "", {"collisions": 0.0, "jerk": 1.0}) for seed in range(60)]
    own = [
        Outcome("open", seed, True, 20, "", {"collisions": 4.0 if seed < runs_into else 0.0, "jerk": 1.0})
        for seed in range(60)
    ]
    result = found(Motion(metrics=("collisions",)), episodes=episodes(base, own))
    assert (result.verdict, result.sentence) == (verdict, says)
    both = found(Motion(metrics=("jerk", "collisions")), episodes=episodes(base, own))
    assert both.verdict == verdict
    assert says in both.sentence
    rough = [Outcome("open", one.seed, True, 20, "", one.motion | {"jerk": 2.0}) for one in own]
    both = found(Motion(metrics=("jerk", "collisions")), episodes=episodes(base, rough))
    assert both.verdict == "fail"
    assert ("jerk +100.0%" in both.sentence, says in both.sentence) == (True, verdict == "fail"), "only what fails"


def test_without_positions_or_common_successes_nothing_is_decided():
    bare = episodes(played(1, 60, own=False), played(2, 60, own=False))
    assert found(Motion(), episodes=bare).verdict == "inconclusive"
    lost = episodes(played(1, 30), played(2, 30, lost=dict.fromkeys(TASKS, 1.0)))
    for result in (found(Motion(), episodes=lost), found(TaskTime(), episodes=lost)):
        assert result.verdict == "inconclusive"
        assert "both succeed" in result.sentence


@pytest.mark.parametrize(("time", "verdict"), [(1.0, "pass"), (1.2, "fail"), (1.05, "inconclusive")])
def test_a_longer_task_fails(time: float, verdict: str):
    result = found(TaskTime(), episodes=episodes(played(1, 300), played(2, 300, time=time)))
    assert result.verdict == verdict, result.sentence


def test_a_task_that_is_lost_fails_however_well_the_others_do():
    bad = episodes(played(1, 600), played(2, 600, lost={"close": 0.3}))
    result = found(WorstTask(), episodes=bad)
    assert result.verdict == "fail"
    assert re.search(r"^more failed episodes: close \+2\d\.\d\d%", result.sentence)
    assert result.measurements[0].note == "close"
    assert found(WorstTask(), episodes=episodes(played(1, 30), played(2, 30))).verdict == "inconclusive"
    good = played(1, 3000)
    assert found(WorstTask(), episodes=episodes(good, good)).verdict == "pass"


def test_a_disturbance_that_costs_more_than_the_baseline_fails():
    same = played(1, 600)
    frail = episodes(same, same, delay=(same, played(3, 600, lost=dict.fromkeys(TASKS, 0.4))), light=(same, same))
    result = found(Disturbed(), episodes=frail)
    assert (result.verdict, "delay" in result.sentence, "light" in result.sentence) == ("fail", True, False)
    firm = episodes(same, same, delay=(same, same), light=(same, same))
    assert found(Disturbed(), episodes=firm).verdict == "pass"


@pytest.mark.soak("each claim on its own here; a whole gate: tests/gate/test_gate_run.py")
def test_a_gate_with_every_claim_runs_the_episodes_once(tmp_path: Path):
    good, rough, eager = (bundle_of(tmp_path / name, kind) for name, kind in
                          (("good", (0.2, 0.0)), ("rough", TREMBLES), ("eager", EAGER)))  # fmt: skip
    gate = Gate.model_validate({
        "accuracy": {"max_drop": 0.2, "episodes": 40, "policy": good.path.parent / "policy"}, "latency": None,
        "answers": None, "memory": None, "size": None, "motion": {}, "task_time": {}, "worst_task": {"max_drop": 0.5},
        "disturbed": {"max_drop": 0.2, "kinds": ["delay"], "strength": 3},
    })  # fmt: skip

    def verdicts(candidate: Any) -> dict[str, str]:
        row: Row = run_gate(candidate, good, gate, Context(), seed=1).rows[-1]
        return {record["claim"]: record["verdict"] for record in row.details["claims"]}

    passed = {"accuracy": "pass", "motion": "pass", "task_time": "pass", "worst_task": "pass", "disturbed": "pass"}
    assert verdicts(good) == passed
    assert verdicts(rough) == {**passed, "motion": "fail"}
    verdict = verdicts(eager)
    assert (verdict["accuracy"], verdict["worst_task"], verdict["disturbed"]) == ("pass", "pass", "fail")


def test_claims_of_episodes_need_episodes(tmp_path: Path):
    with pytest.raises(ValidationError, match=r"motion, disturbed is claimed of closed-loop episodes.*accuracy"):
        Gate.model_validate({"motion": {}, "disturbed": {}})
    file = tmp_path / "gate.yaml"
    file.write_text(gate_files("baseline", "candidate")["gate.yaml"])
    gate = read_gate(file)
    assert (gate.motion, gate.task_time, gate.worst_task, gate.disturbed) == (None,) * 4
    text = file.read_text()
    for name in ("motion", "task_time", "worst_task", "disturbed"):
        text = re.sub(rf"^{name}: null.*\n# {name}:\n#  ( .*)$", rf"{name}:\n \1", text, flags=re.MULTILINE)
    file.write_text(text.replace("# episodes: 200", "episodes: 200"))
    gate = read_gate(file)
    assert (gate.motion.margin, gate.task_time.margin) == (0.1, 0.05)
    assert (gate.worst_task.max_drop, gate.disturbed.max_drop) == (0.03, 0.05)


def told(count: int, missing: Collection[int] = (), names: Collection[str] = ("path_length", "jerk"), **more: Any):
    """Episodes that all succeed; some lost what they told of the body at one step."""
    return [
        replace(each, success=True, **more, motion={
            name: value for name, value in each.motion.items() if number not in missing or name not in names
        }) for number, each in enumerate(played(1, count))
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("ours", "theirs", "says"),
    [
        (range(45, 400), range(45, 400), "known of both in 45 of 400 common successes, and it takes 90%"),
        (range(45, 400), (), "known of both in 45 of 400 common successes"),
        ((), range(300), "known of both in 100 of 400"),
        (range(30), (), "missing in 30 common successes where the baseline has it, the other way round in 0"),
        (range(2), (), "missing in 2 common successes"),
        (
            range(20),
            range(20, 24),
            "in 20 common successes where the baseline has it, the other way round in 4",
        ),
        (range(400), (), "known of both in 0 of 400"),
    ],
)
@pytest.mark.parametrize("metrics", [(), ("jerk",), ("path_length", "jerk")])
def test_values_that_are_missing_let_nothing_pass(ours, theirs, says: str, metrics: tuple[str, ...]):
    result = found(Motion(metrics=metrics), episodes=episodes(told(400, theirs), told(400, ours)))
    assert result.verdict == "inconclusive", result.sentence
    assert says in result.sentence


@pytest.mark.parametrize(
    ("ours", "theirs"), [((), ()), (range(5), range(5)), (range(5), range(5, 10)), ([7], ()), ((), range(20))]
)
def test_values_that_are_missing_by_chance_are_reported(ours, theirs):
    result = found(Motion(), episodes=episodes(told(400, theirs), told(400, ours)))
    assert result.verdict == "pass", result.sentence
    lost = len({*ours, *theirs})
    assert (f"unknown in {lost} of them" in result.sentence) == (lost > 0)


def test_missing_values_do_not_leave_another_metric_to_decide():
    """The baseline tells of a path, the candidate of no place at all: how its actions change is no answer."""
    base, own = told(60), told(60, range(60))
    base, own = ([replace(each, motion={**each.motion, "action_rate": 1.0}) for each in some] for some in (base, own))
    result = found(Motion(), episodes=episodes(base, own))
    assert (result.verdict, "no ratio of path_length" in result.sentence) == ("inconclusive", True)


def test_a_metric_that_the_baseline_has_nothing_of_needs_its_values_too():
    base = [Outcome("open", seed, True, 20, "", {"collisions": 0.0}) for seed in range(60)]
    own = [replace(each, motion={} if each.seed < 20 else each.motion) for each in base]
    result = found(Motion(metrics=("collisions",)), episodes=episodes(base, own))
    assert (result.verdict, "known of both in 40 of 60" in result.sentence) == ("inconclusive", True)


def test_task_time_needs_its_values_too():
    base, own = told(60), told(60, range(30), ("task_time",))
    result = found(TaskTime(), episodes=episodes(base, own))
    assert (result.verdict, "known of both in 30 of 60" in result.sentence) == ("inconclusive", True)


def test_a_clock_that_went_wrong_in_one_arm_gives_no_pair():
    """Its rate is that of the spec then, so that jerk would be many times smaller than by the clock."""
    base, own = told(60), told(60)
    own = [replace(each, refused={"time": "it is told at 5 of 7 moments"}, motion={"jerk": 1e-6}) for each in own]
    for metrics in ((), ("jerk",)):
        assert found(Motion(metrics=metrics), episodes=episodes(base, own)).verdict == "inconclusive"
    both = [[replace(each, refused={"time": "it stands"}) for each in told(60)] for _ in range(2)]
    assert found(Motion(), episodes=episodes(*both)).verdict == "pass"


def begun(outcomes: list[Outcome], count: int) -> list[Outcome]:
    return [replace(each, start=str(number % count)) for number, each in enumerate(outcomes)]


@pytest.mark.parametrize("claim", [Motion(), TaskTime(), WorstTask(max_drop=0.99), Disturbed(max_drop=0.99)])
def test_episodes_that_begin_alike_decide_nothing(claim):
    """Three hundred episodes of three starts, each a hundred times."""
    one = begun([replace(each, success=True) for each in played(1, 3)] * 100, 3)
    one = [replace(each, seed=seed) for seed, each in enumerate(one)]
    alike = found(claim, episodes=episodes(one, one, delay=(one, one)))
    assert (alike.verdict, "3 distinct starts" in alike.sentence) == ("inconclusive", True), alike.sentence
    apart = [replace(each, start="") for each in one]
    assert found(claim, episodes=episodes(apart, apart, delay=(apart, apart))).verdict == "pass"
