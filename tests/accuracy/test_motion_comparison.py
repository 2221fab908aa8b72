"""How a variant moves beside the baseline: which episodes count, and what is named."""

from __future__ import annotations

import math

import pytest

from vlatool.accuracy.motion_comparison import drops_by_task, ratios
from vlatool.accuracy.success_comparison import Outcome, compare_success, success_row
from vlatool.evaluate._sentences import sentences
from vlatool.measures import with_derived
from vlatool.render._format import full
from vlatool.report import Measurement, Row


def outcome(task: str, seed: int, success: bool, steps: int, words: str = "", **motion: float) -> Outcome:
    return Outcome(task, seed, success, steps, words, motion)


def rows(base: list[Outcome], own: list[Outcome]) -> tuple[Row, Row]:
    baseline = success_row("baseline", "baseline", base)
    return baseline, compare_success(baseline, success_row("int8", "subject", own))


def test_only_episodes_in_which_both_succeed_are_compared():
    base = [outcome("a", seed, seed != 0, 10, jerk=1.0) for seed in range(20)]
    own = [outcome("a", seed, seed != 1, 10, jerk=50.0 if seed < 2 else 2.0) for seed in range(20)]
    _, row = rows(base, own)
    assert row.get("jerk_ratio").value == pytest.approx(2.0)
    assert row.get("jerk_ratio").samples == 18
    assert row.value("jerk") == pytest.approx((50 + 18 * 2.0) / 19), "alone, of all that it succeeds in"


def test_an_episode_that_does_not_tell_is_left_out():
    base = [outcome("a", seed, True, 10, **({} if seed < 5 else {"jerk": 1.0})) for seed in range(20)]
    own = [outcome("a", seed, True, 10, jerk=3.0) for seed in range(20)]
    _, row = rows(base, own)
    assert (row.get("jerk_ratio").samples, row.value("jerk_ratio")) == (15, 3.0)
    assert math.isnan(rows(base, own)[0].raw["motion.jerk"][0])


def test_failures_count_at_full_length():
    base = [outcome("short", seed, True, 10) for seed in range(10)] + [outcome("long", s, True, 50) for s in range(10)]
    own = [outcome("short", seed, seed > 4, 10 if seed > 4 else 3) for seed in range(10)]
    own += [outcome("long", seed, True, 50) for seed in range(10)]
    base[0] = outcome("short", 0, False, 40)
    _, row = rows(base, own)
    assert row.value("steps_ratio") == pytest.approx((5 * 40 + 5 * 10 + 500) / (40 + 90 + 500))


def test_a_quick_failure_is_not_a_quick_success():
    base = [outcome("a", seed, True, 30) for seed in range(40)]
    own = [outcome("a", seed, seed % 2 == 0, 30 if seed % 2 == 0 else 2) for seed in range(40)]
    assert rows(base, own)[1].value("steps_ratio") == 1.0


def test_the_worst_task_is_named_and_the_table_begins_with_it():
    base = [outcome(task, seed, True, 10) for task in ("x", "y", "z") for seed in range(30)]
    own = [outcome(task, seed, task != "y" or seed > 5, 10) for task in ("x", "y", "z") for seed in range(30)]
    baseline, row = rows(base, own)
    worst = row.get("worst_task_drop")
    assert (worst.value, worst.samples, worst.note) == (pytest.approx(0.2), 30, "y, the worst of 3 tasks")
    assert worst.confidence == pytest.approx(1 - 0.05 / 3)
    assert worst.low < 0.2 < worst.high
    table = row.details["against the baseline, by task"]
    assert [record["task"] for record in table] == ["y", "x", "z"]
    assert (table[0]["baseline"], table[0]["success"], table[0]["drop"]) == (1.0, 0.8, 0.2)
    assert {task: drop.value for task, drop in drops_by_task(baseline, row).items()} == {
        "x": 0.0, "y": pytest.approx(0.2), "z": 0.0,
    }  # fmt: skip


def test_instructions_have_a_table_of_their_own():
    words = ("open it", "pull it open")
    base = [outcome("a", seed, True, 10, words[seed % 2], jerk=1.0) for seed in range(40)]
    own = [
        outcome("a", seed, seed % 2 == 0 or seed > 9, 10, words[seed % 2], jerk=1.0 + seed % 2) for seed in range(40)
    ]
    _, row = rows(base, own)
    first, second = row.details["against the baseline, by instruction"]
    assert (first["instruction"], first["drop"], first["jerk, x"]) == ("pull it open", 0.25, 2.0)
    assert (second["instruction"], second["jerk, x"]) == ("open it", 1.0)
    assert "against the baseline, by task" not in row.details, "there is one task alone"
    assert row.get("worst_task_drop") is None


def test_many_instructions_have_none():
    base = [outcome("a", seed, True, 10, f"go to {seed}") for seed in range(80)]
    _, row = rows(base, base)
    assert "instruction" not in row.raw
    assert "success by instruction" not in row.details


def test_few_common_successes_give_no_ratio_in_a_table():
    base = [outcome(task, seed, True, 10, jerk=1.0) for task in ("x", "y") for seed in range(20)]
    own = [outcome(task, seed, task == "x" or seed < 7, 10, jerk=1.0) for task in ("x", "y") for seed in range(20)]
    worst, other = rows(base, own)[1].details["against the baseline, by task"]
    assert "jerk, x" not in worst
    assert other["jerk, x"] == 1.0


def test_ratios_may_be_asked_for_with_another_confidence():
    base = [outcome("a", seed, True, 10, jerk=1.0 + seed % 3, path_length=1.0) for seed in range(60)]
    own = [outcome("a", seed, True, 10, jerk=1.2 + seed % 4, path_length=1.0) for seed in range(60)]
    baseline, row = rows(base, own)
    narrow, wide = (ratios(baseline, row, ("jerk",), confidence)["jerk"].measured for confidence in (0.5, 0.999))
    assert set(ratios(baseline, row, ("jerk",))) == {"jerk"}
    assert wide.low < narrow.low < narrow.high < wide.high
    assert wide.confidence == 0.999


def test_a_task_gains_what_more_steps_leave():
    steps = Measurement("steps_ratio", 1.25, "x", samples=100, low=1.2, high=1.3)
    row = Row("int8", measurements=(Measurement("speedup", 2.0, "x", low=1.9, high=2.1), steps))
    task = with_derived(row).get("task_speedup")
    assert (task.value, task.low, task.high) == (1.6, pytest.approx(1.9 / 1.3), pytest.approx(2.1 / 1.2))
    assert with_derived(Row("a", measurements=(steps,))).get("task_speedup") is None


@pytest.mark.parametrize(("pairs", "moves", "why"), [
    (6, 6, "no interval: 6 pairs, and it takes 8"),
    (400, 3, "no interval: too few pairs in which the baseline's is not 0"),
    (400, 40, ""), (8, 8, ""),
])  # fmt: skip
def test_a_ratio_without_an_interval_says_why(pairs: int, moves: int, why: str):
    base = [outcome("a", seed, True, 10, reversals=0.1 if seed < moves else 0.0) for seed in range(pairs)]
    own = [outcome("a", seed, True, 10, reversals=0.2 if seed < moves else 0.0) for seed in range(pairs)]
    ratio = rows(base, own)[1].get("reversals_ratio")
    assert ratio.value == pytest.approx(2.0)
    assert (ratio.low is None, ratio.high is None) == (bool(why), bool(why))
    assert full(ratio) == f"2.00× ({why}, n = {pairs})" if why else "no interval" not in ratio.note


def test_what_the_baseline_has_none_of_is_told_though_it_has_no_ratio():
    base = [outcome("a", seed, True, 10, collisions=0.0, reversals=0.0) for seed in range(40)]
    own = [outcome("a", seed, seed > 0, 10, collisions=2.0 if seed < 11 else 0.0, reversals=0.0) for seed in range(40)]
    baseline, row = rows(base, own)
    assert row.get("collisions_ratio") is None
    added = row.get("collisions_added")
    assert (added.value, added.unit, added.samples) == (pytest.approx(20 / 39), "count", 39)
    assert (
        added.note == "mean of 39 episodes in which both succeed: above 0 in 10 of them, and in none of the baseline's"
    )
    assert row.get("reversals_added") is None, "neither has any"
    sentence = (
        "Where both succeed, the baseline has none of these: collisions (in 10 of 39 episodes, 0.513 on average)."
    )
    assert sentence in sentences((baseline, row), "")
    few = [outcome("a", seed, True, 10, collisions=2.0 if seed < 5 else 0.0) for seed in range(40)]
    baseline, row = rows([outcome("a", seed, True, 10, collisions=0.0) for seed in range(40)], few)
    assert row.value("collisions_added") == 0.25
    assert not any("collisions" in said for said in sentences((baseline, row), "")), "five may be chance"
