"""Ratios of motion held against a margin, each with its share of the chance of a false verdict."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.accuracy.motion_comparison import Ratio
from vlatool.gate.claim import Claim
from vlatool.gate.plan import Need
from vlatool.gate.verdict import CONFIDENCE, Judgement, Outcome, judge_interval, samples_wanted, worst

MAX_PAIRS = 100_000
"""Common successes beyond which it is not a useful advice that they would decide."""


class Ratios(Claim):
    """Base of claims about ratios to the baseline: one above 1 + margin fails, all must be shown to be below."""

    needs = frozenset({Need.EPISODES})

    margin: float
    """Largest growth, a share."""

    def judge(self, title: str, ratio: Ratio) -> Judgement:
        """Hold a ratio against the limit."""
        return judge_interval(ratio.measured, 1 + self.margin, title, remarks=ratio.remarks)

    def ratio_words(self, judged: Sequence[Judgement]) -> str:
        """Return the ratios that decide, and how many episodes would where they do not."""
        outcome = worst(each.outcome for each in judged)
        shown = [each for each in judged if each.outcome is outcome]
        count = max(each.measured.samples for each in judged if each.measured)
        end = f"{count} common successes; allowed: {self.margin:+.1%}"
        wanted = [samples_wanted(each) for each in shown]
        if outcome is Outcome.INCONCLUSIVE and all(wanted) and max(wanted) <= MAX_PAIRS:
            end += f"; about {max(wanted):,} would decide"
        return f"{', '.join(map(_words, shown))} ({end})"


def confidence_of(count: int) -> float:
    """Return the coverage of each of several intervals, one of which alone may decide (Bonferroni)."""
    return 1 - (1 - CONFIDENCE) / max(1, count)


def _words(judged: Judgement) -> str:
    ratio = judged.measured
    if ratio is None:
        return judged.title
    span = "" if ratio.low is None or ratio.high is None else f" ({ratio.low - 1:+.1%} to {ratio.high - 1:+.1%})"
    remarks = "; ".join(judged.facts["remarks"])
    return f"{judged.title} {ratio.value - 1:+.1%}{span}{f', {remarks}' if remarks else ''}"
