"""The envelope: scenarios that hold, and that fail as soon as the check behind them is taken out of the code.

Each scenario takes the class ``Envelope``. ``MUTATIONS`` has at least one line for each check: what is removed from the
source, and the scenario that must then fail.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from _envelope_attacks import KINDS, Robot, attack, refused
from _envelope_judge import excesses

import vlatool.runtime.envelope as package
from vlatool.errors import DataError, UsageError
from vlatool.runtime.envelope import Box, Envelope, JointLimits, KeepApart, Level, Monitor, RobotLimits

T = 0.02
SLIDE = RobotLimits("slide", (JointLimits("x", "m", 0.0, 1.0, (-0.5, 0.5), 2.0, 40.0),))
AXES = tuple(JointLimits(name, "m", -1.0, 1.0, (-0.5, 0.5), 2.0, 40.0) for name in "xy")
CART = RobotLimits("cart", AXES, "cartesian")
HAND = SLIDE.plus(JointLimits("gripper", "m", 0.0, 0.1, command="range"))
Make = Callable[..., Any]


def at(make: Make, position: float = 0.5, limits: RobotLimits = SLIDE, **options: Any) -> Any:
    """An envelope that rests with all joints at a position."""
    envelope = make(limits, T, **options)
    envelope.start([position] * len(limits.joints))
    return envelope


def move(envelope: Any, steps: int = 40, speed: float = 0.4) -> float:
    """Move the slide at a speed in m/s, reached smoothly; return where it is."""
    x = envelope.position[0]
    for step in range(steps):
        share = min(1.0, (step + 1) / 30)
        x += speed * T * share * share * (3 - 2 * share)
        result = envelope.step([x], elapsed_s=T)
        assert result.checks == (), result
    return float(x)


def run_out(envelope: Any) -> list[float]:
    """Take stop steps until the slide rests; return its positions."""
    found = []
    for _ in range(100):
        if envelope.at_rest():
            return found
        found.append(envelope.step(None, elapsed_s=T).command[0])
    raise AssertionError("it does not stop")


def finite(make: Make) -> None:
    """NaN is answered with a stop from where the robot is, not with zeros, and infinity is not clamped."""
    for bad in (math.nan, math.inf, -math.inf):
        envelope = at(make)
        x = move(envelope)
        result = envelope.step(np.array([bad], np.float32), elapsed_s=T)
        assert result.checks == ("finite",)
        assert result.level is Level.CRITICAL
        assert 0 < result.command[0] - x < 0.4 * T


def fresh(make: Make) -> None:
    """A command that is too old, or comes twice or out of order, stops the robot."""
    envelope = at(make, max_age_s=0.1)
    assert envelope.step([0.5], elapsed_s=T, age_s=0.05, sequence=3).checks == ()
    for age, sequence in ((0.2, 4), (None, 5), (math.nan, 6), (-1.0, 7), (0.05, 3), (0.05, 7)):
        assert envelope.step([0.5], elapsed_s=T, age_s=age, sequence=sequence).checks == ("fresh",), (age, sequence)
    assert envelope.step([0.5], elapsed_s=T, age_s=0.1, sequence=8).checks == ()


def contract(make: Make) -> None:
    """Another shape or dtype is not taken for a command."""
    envelope = at(make, limits=HAND, position=0.05)
    for wrong in (
        [0.05],
        [0.05] * 3,
        np.zeros((1, 2)),
        np.array([0, 0]),
        ["a", 0.0],
        [True, 0.05],
        "ab",
        {0: 1},
        5.0,
        [10**400, 0],
    ):
        result = envelope.step(wrong, elapsed_s=T)
        assert "contract" in result.checks, wrong
        assert result.command == (0.05, 0.05)
        assert result.level is Level.CRITICAL
    for right in ([0.05, 0.05], (0.05, 0.05), np.array([0.05, 0.05]), np.array([0.05, 0.05], np.float32)):
        assert envelope.step(right, elapsed_s=T).checks == ()


def discontinuity(make: Make) -> None:
    """A jump of 5.8 rad is rejected, not slewed, also after a seam or a reset; the robot does not move towards it."""
    arm = RobotLimits.named("franka-panda")
    envelope = make(arm, T)
    envelope.start([-2.89, 0, 0, -1.5, 0, 1.5, 0])
    for _ in range(50):
        result = envelope.step([2.89, 0, 0, -1.5, 0, 1.5, 0], elapsed_s=T)
        assert result.checks == ("discontinuity",)
        assert result.command[0] == -2.89


def start(make: Make) -> None:
    """A start pose that does not fit is refused, not slewed from."""
    envelope = make(HAND, T)
    for wrong in ([1.1, 0.05], [-0.1, 0.05], [math.nan, 0.05], [0.5, 0.2], [0.5], None):
        refused(DataError, lambda wrong=wrong: envelope.start(wrong))
    refused(UsageError, lambda: envelope.step([0.5, 0.05], elapsed_s=T))
    envelope.start([1.0, 0.0])


def moving_start(make: Make) -> None:
    """A robot that moves is neither started anew nor cleared."""
    envelope = at(make)
    move(envelope)
    refused(UsageError, lambda: envelope.start([0.5]))
    refused(UsageError, envelope.clear)
    run_out(envelope)
    envelope.start([0.5])


def late(make: Make) -> None:
    """A command that comes after a long gap is not followed: the stop goes on, at the time that it is."""
    envelope, other = at(make), at(make)
    x = move(envelope)
    move(other)
    result = envelope.step([x], elapsed_s=7 * T)
    assert result.checks == ("late",)
    for _ in range(7):
        stop = other.step(None, elapsed_s=T).command
    assert result.command == pytest.approx(stop, abs=1e-12)


def missed(make: Make) -> None:
    """Without commands, the robot follows its stop to the end, and stays there."""
    envelope = at(make)
    x = move(envelope)
    positions = run_out(envelope)
    assert x < positions[0] < positions[-1] < x + 0.4**2 / 2 / 2.0 + 0.05
    assert envelope.step(None, elapsed_s=T).command == (positions[-1],)


def dead_man(make: Make) -> None:
    """Without the switch the robot stops, and it goes on when it is held again."""
    envelope = at(make, dead_man=True)
    for held in (None, False, 1):
        assert envelope.step([0.5], elapsed_s=T, enabled=held).checks == ("dead-man",)
    assert envelope.step([0.5], elapsed_s=T, enabled=True).checks == ()
    assert at(make).step([0.5], elapsed_s=T, enabled=False).checks == ("dead-man",)


def internal(make: Make) -> None:
    """A check that raises stops the robot until it is cleared."""
    envelope = at(make, limits=CART.outside(Box({"x": 0.8}, {"x": 0.9})), position=0.0)
    boxes, envelope._boxes = envelope._boxes, [[(9, 0.0, 1.0)]]
    assert envelope.step([0.0, 0.0], elapsed_s=T).checks == ("internal", "IndexError")
    envelope._boxes = boxes
    assert envelope.step([0.0, 0.0], elapsed_s=T) == ((0.0, 0.0), ("internal", "IndexError"), Level.EMERGENCY)
    envelope.clear()
    assert envelope.step([0.0, 0.0], elapsed_s=T).checks == ()


def keep_out(make: Make) -> None:
    """Neither a command nor the stop behind it enters a box; along it, and away from it, the robot moves."""
    box = Box({"x": 0.3, "y": -0.2}, {"x": 0.5, "y": 0.2})
    envelope = at(make, limits=CART.outside(box), position=0.0)
    seen = set()
    for step in range(200):
        x = envelope.position[0] + 0.01 * min(1.0, step / 20)
        result = envelope.step([x, 0.0], elapsed_s=T)
        seen.update(result.checks)
        assert result.command[0] < 0.3
    assert "keep-out" in seen
    refused(DataError, lambda: at(make, limits=CART.outside(box), position=0.31).start([0.4, 0.0]))


def readings(make: Make) -> None:
    """A reading slows, stops, or stops until it is cleared; one that is missing stops."""
    near = Monitor("obstacle_m", warning=1.0, critical=0.5, emergency=0.2, slowest=0.2)
    envelope = at(make, 0.1, monitors=(near,))

    def step(value: float | None, speed: float = 0.4) -> Any:
        return envelope.step([envelope.position[0] + speed * T], elapsed_s=T,
                             readings={} if value is None else {"obstacle_m": value})  # fmt: skip

    for _ in range(40):
        assert step(2.0).level <= Level.WARNING
    before = envelope.position[0]
    for _ in range(40):
        before, result = envelope.position[0], step(0.75)
    assert result.level is Level.WARNING
    assert (envelope.position[0] - before) / T == pytest.approx(0.5 * 0.6, abs=1e-6)
    for value in (0.5, 0.3, None, math.nan):
        assert step(value).checks == ("obstacle_m",)
        assert envelope.step([0.0], elapsed_s=T, readings={"obstacle_m": value}).level is Level.CRITICAL
    assert step(0.1).level is Level.EMERGENCY
    assert step(2.0).level is Level.EMERGENCY
    run_out(envelope)
    envelope.clear()
    assert step(2.0, 0.0).level is Level.SAFE


def name_of_a_check(make: Make) -> None:
    """A monitor that has the name of a check does not hide that a command was changed."""
    limits = RobotLimits("cart", (replace(AXES[0], jerk=1e5),))
    envelope = at(make, limits=limits, monitors=(Monitor("acceleration", warning=1.0, critical=2.0),))
    result = envelope.step([0.505], elapsed_s=T, readings={"acceleration": 1.0})
    assert result.checks == ("acceleration",)
    assert result.command[0] == envelope.position[0] < 0.502


def base_while_moving(make: Make) -> None:
    """A reading may concern some joints alone: a base that may not drive while the arm moves."""
    limits = SLIDE.plus(JointLimits("base", "m", velocity=(-0.5, 0.5), acceleration=2.0, jerk=40.0, command="velocity"))
    envelope = make(limits, T, monitors=(Monitor("arm_m_s", 0.1, 0.3, joints=("base",)),))
    envelope.start([0.5, 0.0])
    for _ in range(60):
        result = envelope.step([0.5, 0.4], elapsed_s=T, readings={"arm_m_s": 0.0})
    assert result == ((0.5, 0.4), (), Level.SAFE)
    for _ in range(60):
        result = envelope.step([envelope.position[0] + 0.001, 0.4], elapsed_s=T, readings={"arm_m_s": 0.4})
    assert result.command[1] == pytest.approx(0.0, abs=1e-9)
    assert result.command[0] > 0.51, "the arm goes on"


def escalation(make: Make) -> None:
    """Rejections in a row become an emergency."""
    envelope = at(make, escalate_after=3)
    levels = [envelope.step([9.0], elapsed_s=T).level for _ in range(3)]
    assert levels == [Level.CRITICAL, Level.CRITICAL, Level.EMERGENCY]
    assert envelope.step([0.5], elapsed_s=T).level is Level.EMERGENCY
    other = at(make, escalate_after=3)
    for _ in range(5):
        assert not any(other.step([x], elapsed_s=T).level is Level.EMERGENCY for x in (9.0, 9.0, 0.5))


def clock(make: Make) -> None:
    """Where the clock goes back or says nothing, the robot stops; a step that is too early repeats the last one."""
    envelope = at(make)
    x = move(envelope)
    assert envelope.step([x + 0.008], elapsed_s=0.1 * T) == ((x,), ("early",), Level.WARNING)
    assert envelope.step([x + 0.008], elapsed_s=0.9 * T) == ((x + 0.008,), (), Level.SAFE)
    for elapsed in (math.nan, -1.0, math.inf, "soon"):
        last = envelope.position[0]
        result = envelope.step([x + 0.016], elapsed_s=elapsed)
        assert result.checks == ("clock",)
        assert result.level is Level.CRITICAL
        assert 0 < result.command[0] - last < 0.4 * T
    now = [0.0]
    timed = at(make, clock=lambda: now[0])
    now[0] = T
    assert timed.step([0.5]).checks == ()
    now[0] = -3600.0
    assert timed.step([0.5]).checks == ("clock",)
    now[0] += T
    assert timed.step([0.5]).checks == ()
    broken = at(make)
    broken.clock = lambda: 1 / 0
    assert broken.step([0.5]).checks == ("clock",)


def bands(make: Make) -> None:
    """Inside passes as it is, near is slowed, beyond is rejected."""
    for mode, inside, near, beyond in (
        ("absolute", 0.5001, 0.52, 0.9), ("delta", 1e-4, 0.02, 0.4), ("velocity", 0.005, 0.6, 9.0),
    ):  # fmt: skip
        assert at(make, mode=mode).step([inside], elapsed_s=T) == ((inside,), (), Level.SAFE)
        slowed = at(make, mode=mode).step([near], elapsed_s=T)
        assert slowed.level is Level.WARNING
        assert slowed.checks
        assert 0 < slowed.command[0] - (0.5 if mode == "absolute" else 0.0) < near
        assert at(make, mode=mode).step([beyond], elapsed_s=T).checks == ("discontinuity",)


def behind(make: Make) -> None:
    """Smooth commands that are too fast slow the robot down; it does not freeze."""
    envelope = at(make, 0.1)
    asked, position = 0.1, 0.1
    for _ in range(60):
        asked += 0.55 * T
        last, position = position, envelope.step([asked], elapsed_s=T).command[0]
    assert (position - last) / T == pytest.approx(0.5, abs=1e-6)
    assert 0.05 < asked - position < 0.3


def gripper(make: Make) -> None:
    """A gripper may jump within its range, is moved onto its ends, and keeps its command in a stop."""
    envelope = at(make, limits=HAND, position=0.05)
    assert envelope.step([0.05, 0.1], elapsed_s=T).checks == ()
    assert envelope.step([0.05, 0.105], elapsed_s=T) == ((0.05, 0.1), ("position",), Level.WARNING)
    assert envelope.step([0.05, 3.0], elapsed_s=T).checks == ("discontinuity",)
    assert envelope.step(None, elapsed_s=T).command == (0.05, 0.1)


def apart(make: Make) -> None:
    """A command, or a stop behind one, that would bring parts too near is answered with the stop; one away is not."""
    keep = KeepApart(lambda positions: 0.9 - positions[:, 0], 0.4)
    envelope = make(SLIDE, T, apart=keep)
    envelope.start([0.4999])
    assert envelope.step([0.50001], elapsed_s=T).checks == ("apart",)
    assert envelope.step([0.4998], elapsed_s=T).checks == ()


def attacks(
    limits: RobotLimits, mode: str, kinds: tuple[str, ...] = tuple(KINDS), steps: int = 600
) -> Callable[[Make], None]:
    """A scenario: commands of these kinds, with jitter and gaps, keep every limit within 1e-9."""

    def scenario(make: Make) -> None:
        robot = Robot(limits, T, mode, make=make)
        random = np.random.default_rng(5)
        for _ in range(2):
            worst = attack(robot, steps, random, kinds)
            assert max(worst.values()) <= 1e-9, worst

    return scenario


HARD = ("bang-bang", "sign flips", "parking", "beyond", "missed", "seams")
SCENARIOS: dict[str, Callable[[Make], None]] = {
    scenario.__name__: scenario
    for scenario in (
        finite, fresh, contract, discontinuity, start, moving_start, late, missed, dead_man, internal, keep_out,
        readings, name_of_a_check, base_while_moving, escalation, clock, bands, behind, gripper,
        apart,
    )
} | {
    "positions": attacks(SLIDE, "absolute", HARD),
    "deltas": attacks(HAND, "delta"),
    "velocities": attacks(SLIDE, "velocity", HARD),
    "curve": attacks(RobotLimits.named("fr3").in_order(["joint1", "joint5"]), "absolute", ("parking", "beyond"), 150),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_envelope_keeps_what_it_promises(name: str):
    SCENARIOS[name](Envelope)


MUTATIONS: tuple[tuple[str, str, str, str], ...] = (
    ("finite", "envelope", "not all(map(isfinite, values))", "False"),
    ("fresh", "envelope", "if not self._is_fresh(age, sequence):", "if False:"),
    ("fresh", "envelope", "fresh = fresh and sequence > self._sequence", "pass"),
    ("contract", "envelope", "command.shape != (width,)", "False"),
    ("contract", "envelope", "command.dtype not in FLOATS", "False"),
    ("contract", "envelope", "or not NUMBERS.issuperset(map(type, command))", ""),
    ("discontinuity", "envelope", "if axis.is_discontinuity(wanted, tick):", "if False:"),
    ("start", "envelope", "if not axis.fits(value):", "if False:"),
    ("moving_start", "envelope", "if self.ready and not self.at_rest():", "if False:"),
    ("moving_start", "envelope", "if not self.at_rest():", "if False:"),
    ("late", "envelope", "if interval > self.max_interval_s:", "if False:"),
    ("missed", "envelope", "if command is None:", "if command is None and self._axes and self._axes[0].arm(0.0):"),
    ("dead_man", "envelope", "if not held and", "if False and"),
    ("internal", "envelope", "except Exception as error:", "except KeyboardInterrupt as error:"),
    ("internal", "envelope", "        if self._emergency:\n", "        if False:\n"),
    ("keep_out", "envelope", "if self._boxes and self._enters_box(samples):", "if False:"),
    ("keep_out", "axis", "high if high > last else last)", "value)"),
    ("apart", "envelope", "if self.apart is not None and not", "if False and not"),
    ("readings", "monitor", "if not _is_finite(reading):", "if False:"),
    ("readings", "envelope", "axis.scale_velocity(scale)", "pass"),
    ("name_of_a_check", "envelope", "tuple(sent if slowed else values)", "tuple(values)"),
    ("base_while_moving", "envelope", "Level.WARNING if local else level", "level"),
    ("escalation", "envelope", "if self.escalate_after and", "if False and"),
    ("clock", "envelope", "if interval is None:", "if False:"),
    ("clock", "envelope", "and elapsed >= 0", ""),
    ("behind", "envelope", "axis.request = wanted", "pass"),
    ("gripper", "range_axis", "inside = self.low - TOLERANCE <= value <= self.high + TOLERANCE", "inside = True"),
    ("positions", "axis", "if low < self._low or high > self._high or", "if"),
    ("positions", "axis", "self.slow, self.fast = limits.velocity", "self.slow, self.fast = -9.0, 9.0"),
    ("readings", "axis", "if not slow <= velocity <= fast or", "if"),
    ("positions", "axis", "if not -self._acceleration <= acceleration <= self._acceleration:", "if False:"),
    ("positions", "axis", "if not -self._jerk <= (", "if -1e9 > ("),
    ("positions", "axis", "return (found, check) if found else self._between(stop, wanted, tick)",
     "return Sample(wanted, 0.0, 0.0, (wanted, 0.0, 0.0), wanted, wanted), check"),
    ("positions", "axis", "self.elapsed += interval", "pass"),
    ("deltas", "envelope", "wanted = axis.value + value if relative else value", "wanted = value"),
    ("velocities", "axis", "self.slow, self.fast = limits.velocity", "self.slow, self.fast = -9.0, 9.0"),
    ("velocities", "velocity_axis", "if not -self._acceleration <= acceleration <= self._acceleration:", "if False:"),
    ("velocities", "velocity_axis", "if not -self._jerk <= (", "if -1e9 > ("),
    ("velocities", "velocity_axis", "if low < min(self._low, position) or", "if False and"),
    ("curve", "axis", "if self.curve is not None and not self.curve.allows(self.value, velocity):", "if False:"),
    ("curve", "axis", "if max(velocity, later) > curve.upper(outer[1]) + TOLERANCE:", "if False:"),
)  # fmt: skip
"""Scenario, module, what is removed, and what stands there instead."""


def clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def test_a_guard_that_clamps_one_limit_after_the_other_leaves_them_and_the_envelope_does_not():
    """Position, velocity, acceleration, jerk in turn: with the last clamp, the first limit is no longer kept."""
    joint = SLIDE.joints[0]
    at_, speed, rate, passed = 0.5, 0.0, 0.0, []
    envelope, bounded = at(Envelope), []
    for _ in range(300):
        wanted = 1.0
        velocity = clamp((clamp(wanted, 0.0, 1.0) - at_) / T, *joint.velocity)
        acceleration = clamp((velocity - speed) / T, -joint.acceleration, joint.acceleration)
        rate += clamp((acceleration - rate) / T, -joint.jerk, joint.jerk) * T
        speed += rate * T
        at_ += speed * T
        passed.append((at_,))
        bounded.append(envelope.step([min(wanted, envelope.position[0] + 0.01)], elapsed_s=T).command)
    times = [T * (step + 1) for step in range(300)]
    assert excesses(SLIDE, [False], [0.5], times, passed, T)["position"] > 1e-3
    assert max(excesses(SLIDE, [False], [0.5], times, bounded, T).values()) <= 1e-9
    assert bounded[-1][0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("scenario", "module", "old", "new"), MUTATIONS)
def test_without_a_check_its_scenario_fails(
    monkeypatch: pytest.MonkeyPatch, scenario: str, module: str, old: str, new: str
):
    mutant = mutated(monkeypatch, module, old, new)
    refused(Exception, lambda: SCENARIOS[scenario](mutant.Envelope))


def mutated(monkeypatch: pytest.MonkeyPatch, module: str, old: str, new: str) -> ModuleType:
    """Return the envelope's module with a change in it, or in a module that it imports."""
    folder = Path(package.__file__).parent
    found = ModuleType("none")
    for name in ("monitor", "axis", "velocity_axis", "range_axis", "envelope"):
        full = f"vlatool.runtime.envelope.{name}"
        text = (folder / f"{name}.py").read_text(encoding="utf-8")
        if name == module:
            assert text.count(old) >= 1, old
            text = text.replace(old, new)
        found = importlib.util.module_from_spec(importlib.util.spec_from_loader(full, None))
        monkeypatch.setitem(sys.modules, full, found)
        exec(compile(text, f"{name}.py", "exec"), vars(found))
    return found
