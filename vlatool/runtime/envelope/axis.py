"""One joint or axis of an envelope: what it was last told, and the stop that is proven from there.

Limits hold for the divided differences of what is sent at times t_0, t_1, ... (order n, times n factorial; at a
constant rate these are the usual finite differences): velocity of two positions, acceleration of three, jerk of four.
By the mean value theorem for divided differences (de Boor, "A Practical Guide to Splines", chapter I), samples of a
motion within the limits have differences within them, whatever the times. So an axis keeps one such motion that passes
through its last samples and ends at rest: a proven stop. A command is admitted only if its differences are within the
limits and such a motion passes through it, too. If none does, the motion that is known already is sampled instead, at
the time that it is: that is always legal, and so each step has a proven stop if the first has one.

The motion through the last samples is a cubic (a quadratic for velocities) with a constant jerk, then a stop of
``stop_range``. The jerk is free within the limit; 0 is tried first, then those with which the axis brakes already.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

from vlatool.runtime.envelope.limits import JointLimits, VelocityCurve
from vlatool.runtime.envelope.stop import Phases, stop_phases, stop_range, stop_state

TOLERANCE = 5e-10
"""By how much rounding may take a command beyond a limit, in its units: half of what is promised."""
PROOF_MARGIN = 1e-8
"""Share of the limits that stops and slowed commands leave to rounding: of jerks, it grows with the rate cubed."""
BISECTIONS = 10
BRAKING_SHARES = (0.0, 0.5, 1.0)
"""Jerks that may have led to a sample, as shares of the strongest braking one, in the order in which they are tried."""
MAX_LAG = 10
"""How far commands may go ahead of an axis that is slowed, in jumps that are discontinuities."""
CURVE_POINTS = 24
"""Parts of a stop in each of which its greatest velocity must be allowed at its outermost position."""


class Tick(NamedTuple):
    """Times of one step, shared by all axes; what each command is checked with is read by its index, which is faster.

    Args:
        interval: time since the last command, in s.
        first: 1 / interval.
        second: 2 / (the last two intervals).
        third: 3 / (the last three intervals).
        half: interval / 2.
        lever: time from the middle of the last three samples to this one, in s.
        rise: velocity at this sample for each unit of the jerk of the cubic through the last three, in s^2.
        period: nominal interval, in s.
        longest: longest interval that positions of velocity commands are proven for, in s.
    """

    interval: float
    first: float
    second: float
    third: float
    half: float
    lever: float
    rise: float
    period: float
    longest: float

    @classmethod
    def of(cls, interval: float, last: float, before: float, period: float, longest: float) -> Tick:
        """Return the times of a step after the intervals ``before`` and ``last``."""
        lever = (2 * interval + last) / 3
        return cls(
            interval, 1 / interval, 2 / (interval + last), 3 / (interval + last + before), interval / 2, lever,
            interval * (lever / 2 - interval / 6), period, longest,
        )  # fmt: skip


class Sample(NamedTuple):
    """What an axis would be told, with its differences and the stop behind it.

    Args:
        value: position, or velocity of an axis that takes velocities.
        velocity: first difference (the value itself for velocities), in units/s.
        acceleration: in units/s^2.
        start: position, velocity and acceleration at which a new stop begins; None while the old one goes on.
        low: least position until that stop ends.
        high: greatest position until then.
    """

    value: float
    velocity: float
    acceleration: float
    start: tuple[float, float, float] | None
    low: float
    high: float


class PositionAxis:
    """An axis that takes positions.

    Args:
        limits: of this axis.
        near: commands farther from the last one than so many periods at the velocity limit are a discontinuity.
    """

    def __init__(self, limits: JointLimits, near: float) -> None:
        self.name, self.near = limits.name, near
        self.low, self.high = limits.bounds
        self.curve = limits.curve
        self.slow, self.fast = limits.velocity
        self.max_acceleration = limits.acceleration * (1 - PROOF_MARGIN)
        self.max_jerk = limits.jerk * (1 - PROOF_MARGIN)
        self.reach = near * max(-self.slow, self.fast)
        self._low, self._high = self.low - TOLERANCE, self.high + TOLERANCE
        self._slow, self._fast = self.slow - TOLERANCE, self.fast + TOLERANCE
        self._acceleration, self._jerk = limits.acceleration + TOLERANCE, limits.jerk + TOLERANCE
        self.scale_velocity(1.0)
        self.arm(0.0)

    def copy(self) -> PositionAxis:
        """Return an axis that goes on from here by itself; its parts are never changed in place."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)  # a third of the time of copy.copy, at each step for each joint
        return twin

    def arm(self, position: float) -> None:
        """Begin at rest at a position."""
        self.value, self.velocity, self.acceleration, self.request = position, 0.0, 0.0, position
        self.start, self.elapsed = (position, 0.0, 0.0), 0.0
        self.phases: Phases | None = None
        self.lowest = self.highest = position

    def scale_velocity(self, scale: float) -> None:
        """Let commands go at a share of the velocity limit; what is faster already brakes as fast as it may."""
        self._soft_slow, self._soft_fast = scale * self.slow - TOLERANCE, scale * self.fast + TOLERANCE

    def fits(self, position: float) -> bool:
        """Return whether the axis may begin there."""
        return self._low <= position <= self._high

    def at_rest(self) -> bool:
        """Return whether the stop that is proven has ended."""
        return self.elapsed >= sum(self.stop_phases()[:3])

    def is_discontinuity(self, value: float, tick: Tick) -> bool:
        """Return whether a command is farther from the last one than the axis could go in a few periods.

        Commands that go on smoothly, faster than the axis may, leave it behind; that is one only when it is far behind.
        """
        far = self.reach * max(tick.interval, tick.period)
        return abs(value - self.request) > far or abs(value - self.value) > MAX_LAG * far

    def sample(self, value: float, tick: Tick) -> Sample | None:
        """Return a command with its stop if it may be sent as it is, else None."""
        return self._sample(value, tick, self._soft_slow, self._soft_fast)

    def nearest(self, value: float, tick: Tick) -> tuple[Sample, str]:
        """Return the nearest command that may be sent, and the check that bounds it."""
        stop = self.stop(tick)
        wanted, check = self._within_differences(min(max(value, self.low), self.high), tick)
        check = check or ("position" if not self.low <= value <= self.high else "stop")
        found = self._sample(wanted, tick, self._slow, self._fast)
        return (found, check) if found else self._between(stop, wanted, tick)

    def stop(self, tick: Tick) -> Sample:
        """Return the next sample of the proven stop."""
        value = stop_state(*self.start, self.stop_phases(), self.elapsed + tick.interval)[0]
        velocity = (value - self.value) * tick.first
        acceleration = (velocity - self.velocity) * tick.second
        return Sample(value, velocity, acceleration, None, self.lowest, self.highest)

    def commit(self, sample: Sample, interval: float) -> None:
        """Remember what is sent."""
        self.value, self.velocity, self.acceleration, start, self.lowest, self.highest = sample
        self.request = self.value
        self.elapsed += interval
        if start is not None:
            self.start, self.elapsed, self.phases = start, 0.0, None

    def stop_phases(self) -> Phases:
        """Return the phases of the stop that is proven, from ``start`` on."""
        if self.phases is None:
            _, velocity, acceleration = self.start
            self.phases = stop_phases(velocity, acceleration, self.max_acceleration, self.max_jerk)
        return self.phases

    def _sample(self, value: float, tick: Tick, slow: float, fast: float) -> Sample | None:
        """Check the differences of a command, then look for its stop."""
        velocity = (value - self.value) * tick[1]
        if not slow <= velocity <= fast or not self._low <= value <= self._high:
            return None
        if self.curve is not None and not self.curve.allows(self.value, velocity):
            return None
        acceleration = (velocity - self.velocity) * tick[2]
        if not -self._acceleration <= acceleration <= self._acceleration:
            return None
        if not -self._jerk <= (acceleration - self.acceleration) * tick[3] <= self._jerk:
            return None
        return self._with_stop(value, velocity, acceleration, tick)

    def _with_stop(self, value: float, velocity: float, acceleration: float, tick: Tick) -> Sample | None:
        """Return the sample with a legal stop, for one of the motions that may have led to it."""
        begin, end = velocity + acceleration * tick[4], acceleration
        bounds = self._proof(value, begin, end)
        if bounds is None:
            braking = self._braking_jerk(velocity, acceleration, tick)
            for jerk in (braking / 2, braking):
                begin = velocity + acceleration * tick[4] + jerk * tick[6]
                end = acceleration + jerk * tick[5]
                bounds = self._proof(value, begin, end)
                if bounds is not None:
                    break
            else:
                return None
        low, high = bounds
        last = self.value
        return Sample(value, velocity, acceleration, (value, begin, end), low if low < last else last,
                      high if high > last else last)  # fmt: skip

    def _braking_jerk(self, velocity: float, acceleration: float, tick: Tick) -> float:
        """Return the largest jerk against a velocity with which the accelerations since the last sample are legal."""
        sign = -1.0 if velocity > 0 else 1.0
        toward = sign * acceleration
        jerk = (self.max_acceleration - toward) / tick[5]
        if tick[0] > tick[5]:
            before = (self.max_acceleration + toward) / (tick[0] - tick[5])
            jerk = before if before < jerk else jerk
        jerk = self.max_jerk if self.max_jerk < jerk else jerk
        return sign * jerk if jerk > 0.0 else sign * 0.0

    def _proof(self, value: float, velocity: float, acceleration: float) -> tuple[float, float] | None:
        """Return the least and greatest position of a stop, or None if it leaves the limits."""
        change = acceleration * acceleration / 2 / self.max_jerk
        extreme = velocity + change if acceleration > 0 else velocity - change  # when the acceleration is 0
        if not self._slow <= extreme <= self._fast:  # most of what fails does so here, at a third of the time
            return None
        back, ahead, slowest, fastest = stop_range(velocity, acceleration, self.max_acceleration, self.max_jerk)
        low, high = value + back, value + ahead
        if low < self._low or high > self._high or slowest < self._slow or fastest > self._fast:
            return None
        curve = self.curve
        if curve is None or (slowest >= curve.lower(low) and fastest <= curve.upper(high)):
            return low, high
        return (low, high) if self._follows_curve(curve, (value, velocity, acceleration), low, high) else None

    def _follows_curve(self, curve: VelocityCurve, start: tuple[float, float, float], low: float, high: float) -> bool:
        """Return whether each part of a stop is allowed its greatest velocities at its outermost positions."""
        phases = stop_phases(start[1], start[2], self.max_acceleration, self.max_jerk)
        fastest = max(0.0, -start[2] / phases[3])  # when the acceleration is 0
        part = (sum(phases[:3]) - fastest) / CURVE_POINTS
        times = [0.0, *(fastest + part * index for index in range(CURVE_POINTS + 1))]
        states = [stop_state(*start, phases, time) for time in times]
        for (here, velocity), (there, later) in itertools.pairwise(states):
            turns = velocity * later < 0
            outer = (low, high) if turns else (min(here, there), max(here, there))
            if min(velocity, later) < curve.lower(outer[0]) - TOLERANCE:
                return False
            if max(velocity, later) > curve.upper(outer[1]) + TOLERANCE:
                return False
        return True

    def _within_differences(self, value: float, tick: Tick) -> tuple[float, str]:
        """Return the nearest command with differences within the limits, and the check that bounds it most."""
        wanted = velocity = (value - self.value) * tick.first
        slow, fast = self._soft_slow + TOLERANCE, self._soft_fast - TOLERANCE
        if self.curve is not None:
            slow, fast = max(slow, self.curve.lower(self.value)), min(fast, self.curve.upper(self.value))
        reach, jump = self.max_acceleration / tick.second, self.max_jerk / tick.third / tick.second
        steady = self.velocity + self.acceleration / tick.second
        check = ""
        for name, low, high in (
            ("velocity", slow, fast),
            ("acceleration", self.velocity - reach, self.velocity + reach),
            ("jerk", steady - jump, steady + jump),
        ):
            if not low <= velocity <= high:
                velocity, check = min(max(velocity, low), high), name
        return (value if velocity == wanted else self.value + velocity * tick.interval), check

    def _between(self, stop: Sample, wanted: float, tick: Tick) -> tuple[Sample, str]:
        """Return the sample nearest to a command that has a stop, between the proven one and the command."""
        low, high, found = 0.0, 1.0, stop
        for _ in range(BISECTIONS):
            share = (low + high) / 2
            sample = self._sample(stop.value + share * (wanted - stop.value), tick, self._slow, self._fast)
            if sample is None:
                high = share
            else:
                low, found = share, sample
        return found, "stop"
