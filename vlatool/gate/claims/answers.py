"""The candidate answers while it is timed as it does otherwise, and follows the baseline where nothing was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pydantic import Field

from vlatool.data import RANDOM_KIND, RECORDED_KIND, REWORDED_KIND
from vlatool.gate.claim import Claim
from vlatool.gate.evidence import Evidence
from vlatool.gate.plan import Need, Plan
from vlatool.gate.verdict import Judgement, Outcome, Reason, Verdict
from vlatool.measurement.agreement import SEQUENCE, OutputAgreement
from vlatool.measures.actions import FOLLOWS
from vlatool.report import Measurement

KINDS = {
    RECORDED_KIND: "recorded observations with other bits",
    REWORDED_KIND: "recorded observations under another instruction",
    RANDOM_KIND: "drawn observations",
    SEQUENCE: "observations in a row",
}
EXAMPLE = """
answers:
  follows: 0.5         # least correlation with the baseline where nothing is recorded; null: trained anew
"""


class Answers(Claim):
    """The candidate answers when timed as it does otherwise, and follows the baseline where nothing is recorded."""

    needs = frozenset({Need.AGREEMENT})
    by_default = True
    order = 30
    example = EXAMPLE

    follows: float | None = Field(
        0.5, ge=-1, le=1, description="least correlation with the baseline's answers; null for a policy trained anew"
    )
    observations: int = Field(
        Plan.observations, ge=24, description="observations that both answer, drawn for the purpose"
    )
    seconds: float = Field(
        Plan.answer_seconds, gt=0, description="after which no further one is answered (at least 24 of them)"
    )

    def extend_plan(self, plan: Plan) -> Plan:
        """Ask for as many observations."""
        return replace(super().extend_plan(plan), observations=self.observations, answer_seconds=self.seconds)

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine answers of the process that timed nothing, and those of all that did so far."""
        steady = _steady(evidence)
        follows = None if self.follows is None else self._follows(evidence.agreement.followed)
        found = Verdict.of([steady, *([follows] if follows else [])])
        return replace(found, measurements=tuple(map(_measured, _least(evidence.agreement.followed))))

    def _follows(self, followed: Sequence[OutputAgreement]) -> Judgement:
        """Judge the output that follows the baseline's least."""
        if not (least := _least(followed)):
            return Judgement(Outcome.INCONCLUSIVE, FOLLOWS.name, reason=Reason.NO_EVIDENCE)
        (lowest,) = least
        outcome = Outcome.PASS if lowest.correlation >= (self.follows or 0.0) else Outcome.FAIL
        return Judgement(outcome, FOLLOWS.name, _measured(lowest), self.follows, facts={"followed": lowest})

    def sentence(self, verdict: Verdict) -> str:
        """Return both findings, what fails first."""
        ordered = sorted(verdict.judgements, key=lambda judged: list(Outcome).index(judged.outcome))
        return "; ".join(map(_words, ordered))


def _steady(evidence: Evidence) -> Judgement:
    """Judge answers to the same observation, with the same noise, at different times."""
    asked = (evidence.agreement, *evidence.timed.pairs)
    facts = {name: sum(getattr(process, name) for process in asked) for name in ("looked", "strays", "unsteady")}
    differs = Outcome.INCONCLUSIVE if facts["unsteady"] else Outcome.FAIL
    return Judgement(differs if facts["strays"] else Outcome.PASS, "steady", facts=facts)


def _measured(followed: OutputAgreement) -> Measurement:
    note = f"least correlation with the baseline's answers: {followed.output}, {KINDS[followed.kind]}"
    return FOLLOWS.measurement(followed.correlation, samples=followed.samples, note=note)


def _words(judged: Judgement) -> str:
    if judged.reason is Reason.NO_EVIDENCE:
        return "the baseline answers none of the observations that were drawn for it"
    return _follows_words(judged) if judged.measured else _steady_words(judged.outcome, **judged.facts)


def _steady_words(outcome: Outcome, looked: int, strays: int, unsteady: int) -> str:
    if outcome is Outcome.PASS:
        return f"{looked} answers are given again to the same observations, timed or not"
    words = f"{strays} of {looked} answers to the same observations differ when they are asked for again"
    if outcome is Outcome.INCONCLUSIVE:
        return f"{words}, and {unsteady} of the baseline's: the policy draws numbers of its own"
    return f"{words}, and none of the baseline's: it tells being timed from being used, or keeps what it saw"


def _follows_words(judged: Judgement) -> str:
    lowest: OutputAgreement = judged.facts["followed"]
    words = f"on observations that nobody could know, its {lowest.output} follows the baseline's with a correlation of "
    words += f"{lowest.correlation:.2f} ({lowest.samples} {KINDS[lowest.kind]}; allowed: from {judged.limit:.2f})"
    if judged.outcome is Outcome.PASS:
        return words
    return f"{words}; a policy that was trained anew may need another limit, or none: answers: {{follows: null}}"


def _least(followed: Sequence[OutputAgreement]) -> list[OutputAgreement]:
    """Return the one of least correlation; none when there is none.

    Where there are recordings, observations that are drawn without any are far from what the policy is for, and say
    little of a copy in fewer bits.
    """
    near = [output for output in followed if output.kind != RANDOM_KIND] or list(followed)
    return sorted(near, key=lambda output: output.correlation)[:1]
