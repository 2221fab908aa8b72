"""The candidate moves no more roughly, and no farther, than the baseline where both succeed."""

from __future__ import annotations

from pydantic import Field, model_validator

from vlatool import registry
from vlatool.accuracy.doubt import Doubt
from vlatool.accuracy.motion_comparison import doubts, known_of, pairs_above_none, ratios
from vlatool.gate.claims._ratio import Ratios, confidence_of
from vlatool.gate.evidence import Evidence
from vlatool.gate.verdict import Judgement, Outcome, Reason, Verdict, worst
from vlatool.motion.measure import MIN_PAIRS, metrics
from vlatool.report import Row

OF_BODY = ("path_length", "joint_path", "jerk", "joint_jerk")
OF_ACTIONS = ("action_rate",)
"""Metrics that count where the environment tells nothing of the robot's body."""
NO_METRIC = "no episode in which both succeed tells how they move"
EXAMPLE = """
# These are about the episodes that accuracy names, where it names any:
motion: null           # where both succeed, neither path nor jerk grows by more than the margin
# motion:
#   margin: 0.10
"""


class Motion(Ratios):
    """The candidate moves no more roughly, and no farther, where both succeed (needs ``accuracy: episodes``)."""

    order = 60
    example = EXAMPLE

    margin: float = Field(0.1, ge=0, le=10, description="largest growth of each metric, a share (0.1 = 10 %)")
    metrics: tuple[str, ...] = Field(
        (), description="metrics of motion; paths and jerk of what the environment tells when empty, or action rate"
    )

    @model_validator(mode="after")
    def _metrics_are_known(self) -> Motion:
        known = registry.names("motion")
        if unknown := [name for name in self.metrics if name not in known]:
            raise ValueError(f"there is no metric of motion {', '.join(unknown)}; allowed: {', '.join(known)}")
        return self

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the metrics that the claim names, or those of the body that the environment tells.

        Where the baseline has nothing of a metric (no collision in any episode) there is no ratio: the candidate passes
        with nothing either, and fails where it has some in so many episodes that chance does not explain it.
        """
        rows = evidence.episodes
        names = self.metrics or _metrics_of(rows[0])
        confidence = confidence_of(len(names))
        titles = {name: metric.title for name, metric in metrics().items()}
        found, none = ratios(*rows, names, confidence), pairs_above_none(*rows, names)
        doubt = doubts(*rows, names)
        judged = [Judgement(Outcome.INCONCLUSIVE, name, reason=Reason.MISSING_VALUES, facts={"doubt": doubt.get(name)})
                  for name in names if name not in found and name not in none]  # fmt: skip
        judged += [self.judge(titles[name], found[name]) for name in names if name in found]
        judged += [_from_none(titles[name], *counts, confidence, doubt.get(name)) for name, counts in none.items()]
        return Verdict.of(judged)

    def sentence(self, verdict: Verdict) -> str:
        """Return what fails; else all that is known."""
        lacking = [each for each in verdict.judgements if each.reason is Reason.MISSING_VALUES]
        compared = [each for each in verdict.judgements if each.measured]
        none = [each for each in verdict.judgements if not each.measured and each.reason is Reason.LIMIT]
        parts = [(each.outcome, _none_words(each.title, **each.facts)) for each in none]
        if compared:
            parts.insert(0, (worst(each.outcome for each in compared), self.ratio_words(compared)))
        elif not none:
            parts.append((Outcome.INCONCLUSIVE, NO_METRIC))
        if lacking:
            words = "; ".join(f"no ratio of {each.title} ({each.facts['doubt'] or 'not told'})" for each in lacking)
            parts.insert(0, (Outcome.INCONCLUSIVE, words))
        fails = verdict.outcome is Outcome.FAIL
        return "; ".join(words for outcome, words in parts if outcome is Outcome.FAIL or not fails)


def _metrics_of(baseline: Row) -> tuple[str, ...]:
    """Return the metrics of the body that the baseline has, or that of the actions; no candidate chooses."""
    known = known_of(baseline)
    return tuple(name for name in OF_BODY if name in known) or OF_ACTIONS


def _from_none(title: str, some: int, count: int, confidence: float, doubt: Doubt | None) -> Judgement:
    """Judge a metric that the baseline has nothing of; the test is the exact sign test of pairs, one-sided."""
    unlikely = some and 0.5**some <= (1 - confidence) / 2
    enough = not some and count >= MIN_PAIRS and not doubt
    outcome = Outcome.FAIL if unlikely else Outcome.PASS if enough else Outcome.INCONCLUSIVE
    return Judgement(outcome, title, facts={"some": some, "count": count, "doubt": doubt})


def _none_words(title: str, some: int, count: int, doubt: Doubt | None) -> str:
    if some:
        return f"{title} in {some} of {count} common successes, in none of the baseline's"
    return f"{title} 0 in all {count} common successes of both{f' ({doubt})' if doubt else ''}"
