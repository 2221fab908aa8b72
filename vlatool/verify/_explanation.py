"""An explanation of how a signal of a log differs from the reference, with its evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

CERTAIN_SHARE, CERTAIN_PAIRS, CERTAIN_EVIDENCE = 0.2, 30, 2.0
"""An explanation is certain if it leaves at most this share of the error, on so many pairs; or if it has so many times
the evidence that is needed."""


@dataclass(frozen=True)
class Explanation:
    """What is wrong with a signal.

    Args:
        signal: name of the input or of the action.
        kind: ``permuted``, ``negated``, ``scaled``, ``offset``, ``delayed``, ``swapped``, ``statistics``, ``bgr``,
            ``flipped``, ``absolute``, ``text`` or ``unexplained``.
        where: elements, delay or factor, in words.
        before: error without a change, relative to the spread of the signal, of images to the difference of two frames.
        after: error that the explanation leaves, the same.
        pairs: rows that it rests on.
        paired: whether rows were of the same moments: nothing is certain by means and spreads alone.
        remedy: what to do.
        evidence: logarithm of the likelihood ratio, or margin of a classifier, where episodes are others.
        needed: what that stays below in right logs.
    """

    signal: str
    kind: str
    where: str
    before: float
    after: float
    pairs: int
    paired: bool = True
    remedy: str = "correct what feeds it on the robot, or its entry in the spec"
    evidence: float | None = None
    needed: float = 0.0

    @property
    def certainty(self) -> str:
        """How sure it is: ``certain`` or ``likely``."""
        if self.evidence is not None:
            return "certain" if self.evidence >= CERTAIN_EVIDENCE * self.needed else "likely"
        sure = self.after <= CERTAIN_SHARE * self.before and self.pairs >= CERTAIN_PAIRS
        return "certain" if sure and self.paired and self.kind != "unexplained" else "likely"

    def sentence(self) -> str:
        """Return what is wrong in words, with the evidence."""
        shown = f"error {self.before:.3g} -> {self.after:.3g}"
        if self.evidence is not None:
            shown = f"evidence {self.evidence:.3g}, in right episodes below {self.needed:.3g}"
        fall = f"{shown} on {self.pairs} rows, {self.certainty}"
        return f"'{self.signal}' is {self.kind}: {self.where} ({fall}); {self.remedy}."

    def record(self) -> dict[str, Any]:
        """Return it as a row of a table: with errors, or where episodes are others, with the evidence."""
        paired = self.evidence is None
        numbers = {
            "error before": self.before if paired else None, "error after": self.after if paired else None,
            "evidence": self.evidence, "needed": None if paired else self.needed,
        }  # fmt: skip
        rounded = {key: None if value is None else float(f"{value:.4g}") for key, value in numbers.items()}
        return {"signal": self.signal, "explanation": self.kind, "where": self.where, **rounded,
                "rows": self.pairs, "certainty": self.certainty}  # fmt: skip
