"""The action envelope: what may be sent to a robot, given what was sent before."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from vlatool.errors import DataError, UsageError
from vlatool.files.validate import short_repr
from vlatool.runtime.arguments import check_positive
from vlatool.runtime.envelope.axis import PositionAxis, Sample, Tick
from vlatool.runtime.envelope.keep_apart import KeepApart
from vlatool.runtime.envelope.limits import JointLimits, RobotLimits
from vlatool.runtime.envelope.monitor import Level, Monitor
from vlatool.runtime.envelope.range_axis import RangeAxis
from vlatool.runtime.envelope.velocity_axis import VelocityAxis

MODES = ("absolute", "delta", "velocity")
"""Modes of an action that can be bounded without knowing what it is relative to."""
FLOATS = frozenset(map(np.dtype, (np.float64, np.float32, np.float16)))
NUMBERS = frozenset((float, int, np.float64, np.float32, np.float16))
"""Types of the elements of a command that is a list; a truth value is none of them."""
MIN_PERIOD_S, MAX_PERIOD_S = 5e-4, 10.0
NEAR_PERIODS = 3.0
LONGEST_PERIODS = 4.0
SHORTEST_PERIODS = 0.25


class StepResult(NamedTuple):
    """What may be sent at this step.

    Args:
        command: one number for each joint, in the mode of the action: exactly the caller's where ``checks`` is empty.
        checks: names of the checks that changed or replaced the command, or that report a reading.
        level: how safe the step was.
    """

    command: tuple[float, ...]
    checks: tuple[str, ...]
    level: Level


class Envelope:
    """Bounds the commands of a robot, so that at each step a stop within its limits is known.

    In this order: finite, fresh (age, sequence), contract (shape, dtype), absolute position from the *commanded* state,
    workspace, keep-out boxes and distances to keep, position, velocity, acceleration, jerk, and a stop that is proven
    to stay within all of them. A command within the limits passes unchanged. One that is near is slowed, each joint by
    itself. One that is beyond (a discontinuity, not finite, stale, of another shape) is rejected: the robot follows the
    stop that was proven last. So it does when a check raises, and when no command comes.

    The state belongs to the robot, not to a policy: keep one envelope for each robot across chunks, episodes, fallbacks
    and policies. It is not a safety-rated function, and limits of velocity and acceleration do not bound torque.

    Args:
        limits: of the robot.
        period_s: nominal time between two steps.
        mode: what an action is: ``absolute`` positions, ``delta`` from the last commanded position, or ``velocity``.
        monitors: readings that slow or stop the robot.
        near: a position farther than so many periods at the velocity limit from the last one that was asked for, or a
            velocity so many times its limit, is rejected instead of slowed.
        max_interval_s: longest interval for which the positions of velocity commands are proven, and after which a
            command comes too late and a stop step is sent instead; four periods when None.
        max_age_s: age from which a command is stale; None if ages are not given.
        dead_man: whether each step needs ``enabled=True``.
        escalate_after: rejected steps in a row that become an emergency; 0 for never.
        apart: distance that parts of the robot keep, such as its two arms: neither a command nor the stop behind it
            brings them nearer.
        clock: returns seconds.

    Raises:
        UsageError: when an argument is invalid.

    Example:
        >>> limits = RobotLimits("slide", (JointLimits("x", "m", 0.0, 1.0, (-0.5, 0.5), 2.0, 40.0),))
        >>> envelope = Envelope(limits, 0.02)
        >>> envelope.start([0.5])
        >>> envelope.step([0.5001], elapsed_s=0.02)
        StepResult(command=(0.5001,), checks=(), level=<Level.SAFE: 0>)
        >>> envelope.step([0.9], elapsed_s=0.02).checks
        ('discontinuity',)
    """

    def __init__(
        self,
        limits: RobotLimits,
        period_s: float,
        *,
        mode: str = "absolute",
        monitors: Sequence[Monitor] = (),
        near: float = NEAR_PERIODS,
        max_interval_s: float | None = None,
        max_age_s: float | None = None,
        dead_man: bool = False,
        escalate_after: int = 0,
        apart: KeepApart | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        for name, value in (("period_s", period_s), ("near", near)):
            _check_finite(name, value)
        if not MIN_PERIOD_S <= period_s <= MAX_PERIOD_S:
            raise UsageError(
                f"period_s is {period_s!r}; allowed: {MIN_PERIOD_S} to {MAX_PERIOD_S:g} s.",
                "pass the time between two commands in seconds; faster, rounding hides the jerk",
            )
        for name, optional in (("max_interval_s", max_interval_s), ("max_age_s", max_age_s)):
            _check_finite(name, optional, optional=True)
        if mode not in MODES:
            raise UsageError.unknown(f"An envelope bounds no actions of the mode '{mode}'", mode, MODES)
        self.limits, self.mode, self.monitors, self.period_s = limits, mode, tuple(monitors), float(period_s)
        self.max_age_s, self.dead_man, self.escalate_after, self.clock = max_age_s, dead_man, escalate_after, clock
        self.max_interval_s = float(max_interval_s or LONGEST_PERIODS * period_s)
        self._axes = [_axis(joint, mode, near) for joint in limits.joints]
        self._relative = [mode == "delta" and type(axis) is PositionAxis for axis in self._axes]
        self._check_names(monitors)
        self._boxes = [_sides(limits, box.low, box.high) for box in limits.keep_out]
        self.apart = apart
        if apart is not None and any(isinstance(axis, VelocityAxis) for axis in self._axes):
            raise UsageError(
                "Distances are kept along positions, and a joint takes velocities.",
                "command positions, or pass no apart",
            )
        self.ready = False
        """Whether the envelope was started."""
        self._emergency: tuple[str, ...] = ()
        self._rejections, self._sequence, self._time = 0, -1, 0.0
        self._early = 0.0
        self._last = self._before = self.period_s
        self._scales = [1.0] * len(self._axes)

    def start(self, position: Sequence[float] | None = None) -> None:
        """Begin at rest, where the robot is.

        Args:
            position: measured position of each joint, in the units of the limits; None is enough for axes without
                position limits, such as a mobile base, which begin at 0.

        Raises:
            DataError: when the position is not one finite number for each joint, or not within the limits: the robot
                has to be brought there by other means, as slewing to a limit would be a motion that nobody asked for.
            UsageError: while the robot moves.
        """
        if self.ready and not self.at_rest():
            raise UsageError("The envelope is started while its robot moves.", "step until at_rest() is true")
        values = self._start_values(position)
        for axis, value in zip(self._axes, values, strict=True):
            axis.arm(value)
        self.ready, self._sequence, self._rejections, self._time = True, -1, 0, self.clock()
        self._last = self._before = self.period_s
        self._early = 0.0

    def step(
        self,
        command: Any,
        *,
        elapsed_s: float | None = None,
        age_s: float | None = None,
        sequence: int | None = None,
        readings: Mapping[str, float] | None = None,
        enabled: bool | None = None,
    ) -> StepResult:
        """Return what may be sent now; never raises because of a command or a reading.

        Args:
            command: one finite float for each joint, in the mode of the envelope; None if there is none at this step.
            elapsed_s: time since the last step; the clock's when None.
            age_s: age of the command, from its observation on.
            sequence: number of the command, which must grow from step to step.
            readings: values for the monitors, by name.
            enabled: whether the dead man's switch is held, a truth value of Python or NumPy; None if nobody says. Any
                other value than True stops the robot in any case.

        Raises:
            UsageError: before ``start``.
        """
        if not self.ready:
            raise UsageError("The envelope does not know where its robot is.", "call start(position) first")
        interval = self._elapsed(elapsed_s)
        if interval is not None and interval < SHORTEST_PERIODS * self.period_s:
            self._early = interval
            return self._repeat()
        self._early = 0.0
        try:
            if interval is None:
                return self._reject(self.period_s, ("clock", *self._emergency))
            return self._checked(command, interval, age_s, sequence, readings or {}, enabled)
        except Exception as error:  # whatever a check raises, the robot stops
            self._emergency = ("internal", type(error).__name__)
            return self._stop(interval or self.period_s, self._emergency)

    def copy(self) -> Envelope:
        """Return an envelope that goes on from here by itself, as this one would."""
        twin = copy.copy(self)
        twin._axes = [axis.copy() for axis in self._axes]
        return twin

    def emergency(self, reason: str = "emergency") -> None:
        """Stop the robot, from the next step until ``clear``."""
        self._emergency = (reason,)

    def clear(self) -> None:
        """End an emergency, once the robot is at rest.

        Raises:
            UsageError: while the robot moves.
        """
        if not self.at_rest():
            raise UsageError("An emergency is cleared while the robot moves.", "step until at_rest() is true")
        self._emergency, self._rejections = (), 0

    def at_rest(self) -> bool:
        """Return whether the last proven stop has ended."""
        return all(axis.at_rest() for axis in self._axes)

    @property
    def position(self) -> tuple[float, ...]:
        """The commanded position of each joint; of an axis that takes velocities, the sum of what it was told."""
        return tuple(axis.position if isinstance(axis, VelocityAxis) else axis.value for axis in self._axes)

    @property
    def in_emergency(self) -> bool:
        """Whether only ``clear`` lets the robot move again."""
        return bool(self._emergency)

    def _checked(
        self, command: Any, interval: float, age: Any, sequence: Any, readings: Mapping[str, Any], enabled: Any
    ) -> StepResult:
        values, checks = self._admissible(command, age, sequence)
        level, reports = self._judge(readings)
        held = isinstance(enabled, bool | np.bool_) and bool(enabled)
        if not held and (self.dead_man or enabled is not None):
            checks.append("dead-man")
        if interval > self.max_interval_s:
            checks.append("late")
        if level is Level.EMERGENCY:
            self._emergency = self._emergency or tuple(reports)
        if self._emergency:
            return self._stop(interval, (*checks, *self._emergency))
        if checks or values is None or level is Level.CRITICAL:
            return self._reject(interval, (*checks, *reports))
        return self._bounded(values, interval, reports)

    def _admissible(self, command: Any, age: Any, sequence: Any) -> tuple[list[float] | None, list[str]]:
        """Return the numbers of a command, and the checks that it fails: finite, fresh, contract."""
        if command is None:
            return None, ["missed"]
        values = _numbers(command, len(self._axes))
        checks = []
        if values is not None and not all(map(isfinite, values)):
            checks.append("finite")
        if not self._is_fresh(age, sequence):
            checks.append("fresh")
        if values is None:
            checks.append("contract")
        return values, checks

    def _is_fresh(self, age: Any, sequence: Any) -> bool:
        fresh = self.max_age_s is None or (isinstance(age, int | float) and 0 <= age <= self.max_age_s)
        if sequence is not None:
            fresh = fresh and sequence > self._sequence
            self._sequence = max(self._sequence, sequence)
        return fresh

    def _judge(self, readings: Mapping[str, Any]) -> tuple[Level, list[str]]:
        """Scale the velocities by the readings; return the worst level that concerns all joints, and who reports."""
        if not self.monitors:
            return Level.SAFE, []
        worst, reports = Level.SAFE, []
        scales = [1.0] * len(self._axes)
        for monitor in self.monitors:
            reading = readings.get(monitor.name)
            level, scale = monitor.level(reading), monitor.scale(reading)
            if level is not Level.SAFE:
                reports.append(monitor.name)
            local = bool(monitor.joints) and level is Level.CRITICAL
            worst = max(worst, Level.WARNING if local else level)
            for index, axis in enumerate(self._axes):
                if not monitor.joints or axis.name in monitor.joints:
                    scales[index] = min(scales[index], scale)
        if scales != self._scales:
            self._scales = scales
            for axis, scale in zip(self._axes, scales, strict=True):
                axis.scale_velocity(scale)
        return worst, reports

    def _bounded(self, values: list[float], interval: float, reports: list[str]) -> StepResult:
        """Return the command, or the nearest one, or a stop step if it is a discontinuity or enters a box."""
        tick = Tick.of(interval, self._last, self._before, self.period_s, self.max_interval_s)
        samples: list[Sample] = []
        slowed: list[tuple[PositionAxis, float]] = []
        checks: list[str] = reports
        for axis, value, relative in zip(self._axes, values, self._relative, strict=True):
            wanted = axis.value + value if relative else value
            sample = axis.sample(wanted, tick)
            if sample is None:
                if axis.is_discontinuity(wanted, tick):
                    return self._reject(interval, (*reports, "discontinuity"))
                sample, check = axis.nearest(wanted, tick)
                slowed.append((axis, sample.value if relative else wanted))
                checks = checks if check in checks else [*checks, check]
            samples.append(sample)
        if self._boxes and self._enters_box(samples):
            return self._reject(interval, (*checks, "keep-out"))
        if self.apart is not None and not self.apart.allows(self._axes, samples, interval):
            return self._reject(interval, (*checks, "apart"))
        self._rejections = 0
        sent = self._commit(samples, interval)
        for axis, wanted in slowed:
            axis.request = wanted
        return StepResult(tuple(sent if slowed else values), tuple(checks), Level.WARNING if checks else Level.SAFE)

    def _enters_box(self, samples: Sequence[Sample]) -> bool:
        """Return whether the box around all positions until the stop ends meets a box to keep out of."""
        return any(
            all(samples[axis].low < high and samples[axis].high > low for axis, low, high in box) for box in self._boxes
        )

    def _reject(self, interval: float, checks: tuple[str, ...]) -> StepResult:
        self._rejections += 1
        if self.escalate_after and self._rejections >= self.escalate_after:
            self._emergency = ("rejections",)
            checks = (*checks, "rejections")
        return self._stop(interval, checks)

    def _stop(self, interval: float, checks: tuple[str, ...]) -> StepResult:
        """Follow the stop that was proven last."""
        tick = Tick.of(interval, self._last, self._before, self.period_s, self.max_interval_s)
        rests = interval > 2 * self.period_s and self.at_rest()
        sent = self._commit([axis.stop(tick) for axis in self._axes], interval)
        if rests:  # it has not moved since the last step: the same as after steps at the usual period
            self._last = self._before = self.period_s
            for axis in self._axes:
                axis.acceleration = 0.0
        return StepResult(tuple(sent), checks, Level.EMERGENCY if self._emergency else Level.CRITICAL)

    def _commit(self, samples: Sequence[Sample], interval: float) -> list[float]:
        """Remember what is sent, and return it in the mode of the action."""
        sent = [sample.value for sample in samples]
        if self.mode == "delta":
            columns = zip(self._axes, sent, self._relative, strict=True)
            sent = [value - axis.value if relative else value for axis, value, relative in columns]
        for axis, sample in zip(self._axes, samples, strict=True):
            axis.commit(sample, interval)
        self._last, self._before = interval, self._last
        return sent

    def _repeat(self) -> StepResult:
        """Return the last command again, a delta of 0, as no time has gone by since."""
        held = [0.0 if relative else axis.value for axis, relative in zip(self._axes, self._relative, strict=True)]
        level = Level.EMERGENCY if self._emergency else Level.WARNING
        return StepResult(tuple(held), ("early", *self._emergency), level)

    def _elapsed(self, elapsed: Any) -> float | None:
        """Return the time since the last command that was not a repetition; None if no clock says it."""
        try:
            if elapsed is None:
                now = self.clock()
                elapsed, self._time = now - self._time, now
            elapsed = float(elapsed)
        except Exception:  # whatever a clock raises, the robot stops
            return None
        return elapsed + self._early if isfinite(elapsed) and elapsed >= 0 else None

    def _start_values(self, position: Sequence[float] | None) -> list[float]:
        bounded = [axis.name for axis in self._axes if axis.low > -np.inf]
        if position is None and not bounded:
            return [0.0] * len(self._axes)
        values = None if position is None else _numbers(position, len(self._axes))
        if values is None or not all(map(isfinite, values)):
            raise DataError(
                f"The start position is {short_repr(position)}; allowed: {len(self._axes)} finite numbers.",
                "measure the position of each joint: " + ", ".join(joint.name for joint in self.limits.joints),
            )
        for axis, value in zip(self._axes, values, strict=True):
            if not axis.fits(value):
                raise DataError(
                    f"{axis.name} is at {value:g}; its limits are {axis.low:g} to {axis.high:g}.",
                    "bring the robot into its limits by hand or with its own controller, then start again",
                )
        if any(all(low < values[axis] < high for axis, low, high in box) for box in self._boxes):
            raise DataError("The robot is in a box to keep out of.", "bring it out of the box, then start again")
        return values

    def _check_names(self, monitors: Sequence[Monitor]) -> None:
        names = [monitor.name for monitor in monitors]
        joints = {axis.name for axis in self._axes}
        for monitor in monitors:
            if names.count(monitor.name) > 1 or not joints.issuperset(monitor.joints):
                raise UsageError(
                    f"The monitor {monitor.name} occurs {names.count(monitor.name)} times, for the joints "
                    f"{short_repr(list(monitor.joints))}.",
                    f"give each monitor its own name, and joints of the robot: {', '.join(sorted(joints))}",
                )


def _axis(joint: JointLimits, mode: str, near: float) -> PositionAxis:
    if joint.command == "range":
        return RangeAxis(joint, near)
    return (VelocityAxis if "velocity" in (joint.command, mode) else PositionAxis)(joint, near)


def _sides(limits: RobotLimits, low: Mapping[str, float], high: Mapping[str, float]) -> list[tuple[int, float, float]]:
    """Return index, low and high of each axis of a box."""
    names = [joint.name for joint in limits.joints]
    return [(names.index(axis), low[axis], high[axis]) for axis in low]


def _numbers(command: Any, width: int) -> list[float] | None:
    """Return the elements of a vector of floats; None for another shape or dtype."""
    if isinstance(command, np.ndarray):
        if command.dtype not in FLOATS or command.shape != (width,):
            return None
        values: list[float] = command.tolist()
        return values
    if not isinstance(command, list | tuple) or len(command) != width or not NUMBERS.issuperset(map(type, command)):
        return None
    try:
        return list(map(float, command))
    except OverflowError:
        return None


def _check_finite(name: str, value: Any, *, optional: bool = False) -> None:
    check_positive(name, value, "a number", optional=optional)
    if value is not None and not isfinite(value):
        raise UsageError(f"{name} is {value!r}; allowed: a finite number above 0.", f"pass {name}=0.02, for example")
