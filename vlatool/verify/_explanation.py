"""An explanation of how a signal of a log differs from the reference, with its evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

CERTAIN_SHARE, CERTAIN_PAIRS = 0.2, 30
"""An explanation is certain if it leaves at most this share of the error, on so many pairs."""


@dataclass(frozen=True)
class Explanation:
    """What is wrong with a signal.

    Args:
        signal: name of the input or of the action.
        kind: ``permuted``, ``negated``, ``scaled``, ``offset``, ``delayed``, ``swapped``, ``statistics``, ``bgr``,
            ``flipped``, ``absolute`` or ``unexplained``.
        where: elements, delay or factor, in words.
        before: error without a change, relative to the spread of the signal, of images to the difference of two frames.
        after: error that the explanation leaves, the same.
        pairs: rows that it rests on.
        paired: whether rows were of the same moments: nothing is certain by means and spreads alone.
        remedy: what to do.
    """

    signal: str
    kind: str
    where: str
    before: float
    after: float
    pairs: int
    paired: bool = True
    remedy: str = "correct what feeds it on the robot, or its entry in the spec"

    @property
    def certainty(self) -> str:
        """How sure it is: ``certain`` or ``likely``."""
        sure = self.after <= CERTAIN_SHARE * self.before and self.pairs >= CERTAIN_PAIRS
        return "certain" if sure and self.paired and self.kind != "unexplained" else "likely"

    def sentence(self) -> str:
        """Return what is wrong in words, with the evidence."""
        fall = f"error {self.before:.3g} -> {self.after:.3g} on {self.pairs} rows, {self.certainty}"
        return f"'{self.signal}' is {self.kind}: {self.where} ({fall}); {self.remedy}."

    def record(self) -> dict[str, Any]:
        """Return it as a row of a table."""
        return {
            "signal": self.signal, "explanation": self.kind, "where": self.where,
            "error before": float(f"{self.before:.4g}"), "error after": float(f"{self.after:.4g}"),
            "rows": self.pairs, "certainty": self.certainty,
        }  # fmt: skip
