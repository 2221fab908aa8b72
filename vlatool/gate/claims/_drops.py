"""Drops of success, one for each task or disturbance, held against one limit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from vlatool.accuracy.doubt import Doubt
from vlatool.gate.claim import Claim
from vlatool.gate.plan import Need
from vlatool.gate.verdict import Outcome, Reason, Verdict, judge_interval
from vlatool.report import Measurement

MAX_SHOWN = 3


class Drops(Claim):
    """Base of claims about more failed episodes: a drop above the limit fails, all must be shown to be below."""

    needs = frozenset({Need.EPISODES})

    max_drop: float
    """Largest drop, a share."""

    def judge(self, drops: Mapping[str, Measurement], few: Doubt | None) -> Verdict:
        """Hold drops against the limit.

        Args:
            drops: title -> drop with an interval that allows for their number.
            few: why the episodes decide nothing, whatever the drops; None where they may.
        """
        if not drops:
            return Verdict(Outcome.INCONCLUSIVE, reason=Reason.NO_EVIDENCE)
        found = Verdict.of([judge_interval(drop, self.max_drop, title) for title, drop in drops.items()])
        found = replace(found, measurements=(max(found.measurements, key=lambda drop: drop.value),))
        if few is None:
            return found
        return replace(found, outcome=Outcome.INCONCLUSIVE, reason=Reason.FEW_STARTS, facts={"few": few})

    def sentence(self, verdict: Verdict) -> str:
        """Return the largest of the drops that decide."""
        if verdict.reason is Reason.NO_EVIDENCE:
            return "no episodes were played"
        order = sorted(verdict.decisive, key=lambda judged: -judged.measured.value if judged.measured else 0.0)
        words = "; ".join(_words(judged.title, judged.measured) for judged in order[:MAX_SHOWN] if judged.measured)
        more = f"; and {len(order) - MAX_SHOWN} more" if len(order) > MAX_SHOWN else ""
        few = f"; {verdict.facts['few']}" if verdict.reason is Reason.FEW_STARTS else ""
        return f"more failed episodes: {words}{more}{few}; allowed: {self.max_drop:+.2%}"


def _words(title: str, drop: Measurement) -> str:
    return f"{title} {drop.value:+.2%} ({drop.low or 0.0:+.2%} to {drop.high or 0.0:+.2%}, {drop.samples} episodes)"
