"""Base class of a metric of motion."""

from __future__ import annotations

from typing import ClassVar

from vlatool.motion.track import Track


class Metric:
    """A number of one episode, of which more is worse."""

    title: ClassVar[str]
    unit: ClassVar[str]
    """``length`` is the unit of the positions that the environment tells, ``action`` that of the action's elements;
    ``1`` is a share (shown in per cent), ``count`` a number of things, and nothing another number without a dimension.
    """

    def of(self, track: Track) -> float | None:
        """Return the number; None where the track does not have what it needs."""
        raise NotImplementedError
