"""What a claim says once it was examined."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from vlatool.report import Measurement
from vlatool.stats.sequential import ALPHA

CONFIDENCE = 1 - 2 * ALPHA
"""Of two-sided intervals: a verdict is wrong with chance ``ALPHA`` on either side."""


@dataclass(frozen=True)
class ClaimResult:
    """What an examined claim says.

    Args:
        claim: Its name in the gate file.
        verdict: ``pass``, ``fail`` or ``inconclusive``.
        sentence: In words, without a full stop.
        measurements: For the candidate's row.
        baseline: For the baseline's row.
    """

    claim: str
    verdict: str
    sentence: str
    measurements: tuple[Measurement, ...] = ()
    baseline: tuple[Measurement, ...] = ()


def worst(verdicts: Iterable[str]) -> str:
    """Return ``fail`` when one fails, else ``inconclusive`` when one is, else ``pass``."""
    said = set(verdicts)
    return next((each for each in ("fail", "inconclusive") if each in said), "pass")
