"""An axis that takes velocities, each held until the next: a mobile base, a quadrotor, a joint in velocity mode."""

from __future__ import annotations

from vlatool.runtime.envelope.axis import BRAKING_SHARES, PositionAxis, Sample, Tick
from vlatool.runtime.envelope.stop import stop_range, stop_state


class VelocityAxis(PositionAxis):
    """An axis that takes velocities.

    Its acceleration is the first, its jerk the second divided difference of what is sent. Its position is the sum of
    velocity times interval from where it began. As a velocity is held for up to ``Tick.longest``, positions are proven
    with a margin of that time, times how much the velocity changes in the stop.
    """

    def arm(self, position: float) -> None:
        """Begin at rest at a position."""
        super().arm(position)
        self.position, self.value, self.request = position, 0.0, 0.0

    def is_discontinuity(self, value: float, tick: Tick) -> bool:
        """Return whether a command is far above the velocity limit."""
        return abs(value) > self.reach

    def nearest(self, value: float, tick: Tick) -> tuple[Sample, str]:
        """Return the nearest velocity that may be sent, and the check that bounds it."""
        wanted, check = self._within_differences(value, tick)
        found = self._sample(wanted, tick, self._slow, self._fast)
        return (found, check or "position") if found else self._between(self.stop(tick), wanted, tick)

    def stop(self, tick: Tick) -> Sample:
        """Return the next sample of the proven stop."""
        value = stop_state(*self.start, self.stop_phases(), self.elapsed + tick.interval)[1]
        return Sample(value, value, (value - self.value) * tick.first, None, self.lowest, self.highest)

    def commit(self, sample: Sample, interval: float) -> None:
        """Remember what is sent, and how far the last velocity went."""
        self.position += self.value * interval
        super().commit(sample, interval)

    def _sample(self, value: float, tick: Tick, slow: float, fast: float) -> Sample | None:
        if not slow <= value <= fast:
            return None
        acceleration = (value - self.value) * tick.first
        if not -self._acceleration <= acceleration <= self._acceleration:
            return None
        if not -self._jerk <= (acceleration - self.acceleration) * tick.second <= self._jerk:
            return None
        return self._with_stop(value, value, acceleration, tick)

    def _with_stop(self, value: float, velocity: float, acceleration: float, tick: Tick) -> Sample | None:
        position = self.position + self.value * tick.interval
        for share in BRAKING_SHARES:
            jerk = share and share * self._braking_jerk(velocity, acceleration, tick)
            end = acceleration + jerk * tick.half
            bounds = self._held_proof(position, velocity, end, tick)
            if bounds is not None:
                low, high = min(bounds[0], self.position), max(bounds[1], self.position)
                return Sample(value, velocity, acceleration, (position, velocity, end), low, high)
        return None

    def _braking_jerk(self, velocity: float, acceleration: float, tick: Tick) -> float:
        sign = -1.0 if velocity > 0 else 1.0
        room = (self.max_acceleration - sign * acceleration) / tick.half
        return sign * max(0.0, min(self.max_jerk, room))

    def _held_proof(
        self, position: float, velocity: float, acceleration: float, tick: Tick
    ) -> tuple[float, float] | None:
        """Return the range of positions of a stop whose velocities are held, or None if it leaves the limits."""
        back, ahead, slowest, fastest = stop_range(velocity, acceleration, self.max_acceleration, self.max_jerk)
        if slowest < self._slow or fastest > self._fast:
            return None
        margin = tick.longest * (2 * (fastest - slowest) - abs(velocity))
        low = position + back - (margin if slowest < 0 else 0.0)
        high = position + ahead + (margin if fastest > 0 else 0.0)
        if low < min(self._low, position) or high > max(self._high, position):
            return None  # an axis that a late step took out of its limits may come back
        return low, high

    def _within_differences(self, value: float, tick: Tick) -> tuple[float, str]:
        reach, jump = self.max_acceleration / tick.first, self.max_jerk / tick.second / tick.first
        steady = self.value + self.acceleration / tick.first
        check = ""
        for name, low, high in (
            ("velocity", self._soft_slow, self._soft_fast),
            ("acceleration", self.value - reach, self.value + reach),
            ("jerk", steady - jump, steady + jump),
        ):
            if not low <= value <= high:
                value, check = min(max(value, low), high), name
        return value, check
