"""Limits on motion, steps and the worst task; every row is built by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from vlatool.cli import app
from vlatool.errors import RecipeError, UsageError
from vlatool.optimize.choice import choose
from vlatool.optimize.judge import Judged, judge
from vlatool.optimize.moves import slower_task
from vlatool.optimize.plan import make_plan
from vlatool.optimize.recipe import Effort, Limits, default_recipe
from vlatool.report import Measurement, Row

FLOAT = Row("float32", "baseline", measurements=(Measurement("latency_p50", 10.0, "ms", samples=20),))


def ratio(name: str, value: float, spread: float = 0.02) -> Measurement:
    return Measurement(f"{name}_ratio", value, "x", samples=150, low=value - spread, high=value + spread)


def row(name: str, p50: float, *found: Measurement) -> Row:
    own = (
        Measurement("latency_p50", p50, "ms", samples=20),
        Measurement("speedup", 10 / p50, "x", samples=20, low=9.9 / p50, high=10.1 / p50),
        Measurement("size", 1.0, "MB"),
        Measurement("success_drop", 0.0, "1", samples=200, low=-0.005, high=0.005, note="paired"),
    )
    return Row(name, measurements=(*own, *found))


def held(candidate: Row, **limits: Any) -> Judged:
    return judge(candidate, FLOAT, Limits(**limits), None)


@pytest.mark.parametrize(("found", "within"), [
    ([ratio("jerk", 1.04)], True), ([ratio("jerk", 1.2)], False), ([ratio("path_length", 1.06)], False),
    ([ratio("task_time", 1.06), ratio("jerk", 1.0)], False), ([ratio("joint_jerk", 2.0)], False),
    ([ratio("action_rate", 2.0), ratio("jerk", 1.0)], True), ([ratio("action_rate", 2.0)], False),
    ([ratio("spectral_arc_length", 2.0), ratio("jerk", 1.0)], True),
])  # fmt: skip
def test_jerk_path_and_task_time_may_be_limited(found: list[Measurement], within: bool):
    judged = held(row("int8", 5.0, *found), max_motion=0.05)
    assert judged.within == within
    assert held(row("int8", 5.0, *found)).within, "without the limit it does not matter"
    if not within:
        assert "(--max-motion)" in judged.row.reason
        assert "allowed 5 %" in judged.row.reason


def test_motion_that_the_episodes_cannot_decide_is_a_warning():
    judged = held(row("int8", 5.0, ratio("jerk", 1.03, 0.05)), max_motion=0.05)
    assert judged.within
    said = "jerk is 1.03x that of float32 (0.98x to 1.08x); 150 pairs of episodes cannot exclude more than 5 %"
    assert any(said in text for text in judged.warnings)


def test_motion_without_an_interval_decides_nothing():
    judged = held(row("int8", 5.0, Measurement("jerk_ratio", 1.0, "x", samples=6)), max_motion=0.05)
    assert judged.within
    said = "jerk is 1x that of float32; 6 pairs of episodes cannot exclude more than 5 %"
    assert any(said in text for text in judged.warnings)


def test_motion_that_is_unknown_keeps_no_limit():
    assert "its motion is unknown" in held(row("int8", 5.0), max_motion=0.05).row.reason


def test_another_plan_is_chosen_where_the_fastest_one_moves_worse():
    fast, calm = row("fast", 2.0, ratio("jerk", 1.2)), row("calm", 4.0, ratio("jerk", 1.01))
    for limits, wanted in (({}, "fast"), ({"max_motion": 0.05}, "calm")):
        judged = [held(one, **limits) for one in (FLOAT, fast, calm)]
        assert next(item.row.name for item in choose(judged) if item.row.role == "chosen") == wanted


@pytest.mark.parametrize(("steps", "spread", "within"), [(1.28, 0.1, False), (1.04, 0.01, True), (1.28, 0.4, True)])
def test_a_speed_up_that_more_steps_eat_up_is_none(steps: float, spread: float, within: bool):
    judged = held(row("int8", 5.0, ratio("steps", steps, spread)))
    assert judged.within == within
    if not within:
        assert "it needs 1.28x the steps of float32 (1.18 to 1.38)" in judged.row.reason
        assert "78 % of its speed-up is left for the whole task, required 95 %" in judged.row.reason
        assert held(row("int8", 5.0, ratio("steps", steps, spread)), min_task_share=0.5).within


def worst(value: float, high: float, name: str = "worst_task_drop") -> Measurement:
    return Measurement(name, value, "1", samples=29, low=value - 0.02, high=high, note="close, the worst of 7 tasks")


def test_the_worst_task_may_be_limited():
    judged = held(row("int8", 5.0, worst(0.05, 0.09)), worst_task=0.03)
    assert not judged.within
    assert "success in close drops by 5 points (3 to 9), allowed 3 (--worst-task)" in judged.row.reason
    judged = held(row("int8", 5.0, worst(0.02, 0.06)), worst_task=0.03)
    assert judged.within
    assert any("29 episodes cannot decide it" in text for text in judged.warnings)
    alone = held(row("int8", 5.0), worst_task=0.03)
    assert alone.within, "of one task there is none worse"


def test_what_more_steps_leave_of_a_speed_up_is_said():
    told = row("int8", 5.0, ratio("steps", 1.1), Measurement("task_speedup", 1.82, "x"))
    assert "does its task 1.82x as fast as float32" in slower_task(told)
    assert slower_task(row("int8", 5.0)) == ""


def test_limits_of_episodes_need_episodes(policy_template: Path, tmp_path: Path):
    recipe = default_recipe(Limits(max_motion=0.05, worst_task=0.03), Effort(episodes=0), True)
    with pytest.raises(RecipeError, match="--max-motion and --worst-task are of closed-loop episodes, and none are"):
        make_plan(str(policy_template), None, recipe, tmp_path)
    plan = make_plan(str(policy_template), None, recipe.model_copy(update={"effort": Effort(episodes=4)}), tmp_path)
    (line,) = [line for line in plan.lines() if line.startswith("limits")]
    assert "jerk, path and task time <= 1.05x, drop of the worst task <= 3 points" in line


@pytest.mark.parametrize("option", ["--max-motion", "--worst-task"])
def test_a_limit_that_is_no_share_is_refused(policy_template: Path, tmp_path: Path, option: str):
    done = CliRunner().invoke(app, ["optimize", str(policy_template), "-o", str(tmp_path / "o"), option, "lots"])
    assert isinstance(done.exception, UsageError)
    assert option in done.exception.message
