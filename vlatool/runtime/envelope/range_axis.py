"""An axis that is commanded by position alone, whose motion its hardware limits: a gripper."""

from __future__ import annotations

from vlatool.runtime.envelope.axis import TOLERANCE, PositionAxis, Sample, Tick

MARGIN = 0.1
"""Share of its range by which a command may be outside and is moved to the end; beyond, it is a discontinuity."""


class RangeAxis(PositionAxis):
    """An axis without limits of its motion: positions are kept in its range; where it stops, it keeps its command."""

    def at_rest(self) -> bool:
        """Return whether the axis is proven to be at rest: always, as each command is held."""
        return True

    def is_discontinuity(self, value: float, tick: Tick) -> bool:
        """Return whether a command is clearly out of the range."""
        margin = MARGIN * (self.high - self.low)
        return not self.low - margin <= value <= self.high + margin

    def sample(self, value: float, tick: Tick) -> Sample | None:
        """Return a command in the range, else None."""
        inside = self.low - TOLERANCE <= value <= self.high + TOLERANCE
        return Sample(value, 0.0, 0.0, None, value, value) if inside else None

    def nearest(self, value: float, tick: Tick) -> tuple[Sample, str]:
        """Return the nearest end of the range."""
        end = min(max(value, self.low), self.high)
        return Sample(end, 0.0, 0.0, None, end, end), "position"

    def stop(self, tick: Tick) -> Sample:
        """Return the last command again."""
        return Sample(self.value, 0.0, 0.0, None, self.value, self.value)
