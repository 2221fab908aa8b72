"""Verdicts on claims, as values: sentences about it are made at the end, by the claim."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from vlatool.report import Measurement
from vlatool.stats.outcome import Outcome as Outcome
from vlatool.stats.sequential import ALPHA

CONFIDENCE = 1 - 2 * ALPHA
"""Coverage of two-sided intervals: a verdict is wrong with chance ``ALPHA`` on either side."""


class Reason(Enum):
    """Reason of an outcome: the number against its limit, or why there is nothing that decides."""

    LIMIT = "the number, held against its limit"
    REFERENCE_FAILS = "the baseline does not do its task"
    FEW_STARTS = "episodes begin in too few ways"
    MISSING_VALUES = "values are missing, and not by chance"
    NO_EVIDENCE = "there is nothing to judge"


@dataclass(frozen=True)
class Judgement:
    """One number, held against its limit.

    Args:
        outcome: pass, fail or inconclusive.
        measured: number with its interval and count; None where there is none.
        limit: largest value that passes (or least, where more is better).
        facts: further values that sentences state.
    """

    outcome: Outcome
    title: str = ""
    measured: Measurement | None = None
    limit: float | None = None
    reason: Reason = Reason.LIMIT
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """Verdict on a claim.

    Args:
        outcome: pass, fail or inconclusive.
        measurements: numbers for the candidate's row of the report.
        facts: further values that sentences state.
    """

    outcome: Outcome
    judgements: tuple[Judgement, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    baseline: tuple[Measurement, ...] = ()
    reason: Reason = Reason.LIMIT
    facts: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, judgements: Sequence[Judgement], baseline: tuple[Measurement, ...] = (), **facts: Any) -> Verdict:
        """Return the verdict that the worst of the judgements gives, with their numbers for the report."""
        measured = tuple(each.measured for each in judgements if each.measured is not None)
        reason = Reason.LIMIT if judgements else Reason.NO_EVIDENCE
        return cls(worst(each.outcome for each in judgements), tuple(judgements), measured, baseline, reason, facts)

    @property
    def decisive(self) -> tuple[Judgement, ...]:
        """The judgements with the worst outcome: those that fail, else those that leave it open, else all."""
        outcome = worst(each.outcome for each in self.judgements)
        return tuple(each for each in self.judgements if each.outcome is outcome)


def worst(outcomes: Iterable[Outcome]) -> Outcome:
    """Return ``fail`` when one fails, else ``inconclusive`` when one is, or there is none, else ``pass``."""
    return min(outcomes, key=list(Outcome).index, default=Outcome.INCONCLUSIVE)


def judge_interval(measured: Measurement, limit: float, title: str = "", **facts: Any) -> Judgement:
    """Hold an interval against a limit: one above it fails, one that ends below it passes, another decides nothing.

    Args:
        measured: number with its interval.
        limit: largest value that passes.
        facts: further values that sentences state.
    """
    outcome = Outcome.INCONCLUSIVE
    if measured.low is not None and measured.high is not None:
        below = Outcome.PASS if measured.high <= limit else Outcome.INCONCLUSIVE
        outcome = Outcome.FAIL if measured.low > limit else below
    return Judgement(outcome, title, measured, limit, facts=facts)


def samples_wanted(judged: Judgement) -> int:
    """Return how many samples would decide what is open; 0 where it is decided, or no number would.

    An interval narrows with the root of the number.
    """
    measured, limit = judged.measured, judged.limit
    if judged.outcome is not Outcome.INCONCLUSIVE or measured is None or limit is None or measured.value == limit:
        return 0
    if measured.low is None or measured.high is None:
        return 0
    reach = measured.high - measured.value if measured.value < limit else measured.value - measured.low
    narrower = (reach / abs(limit - measured.value)) ** 2
    return max(measured.samples + 1, math.ceil(measured.samples * narrower))
