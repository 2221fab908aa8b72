"""The candidate answers while it is timed as it does otherwise, and follows the baseline where nothing was recorded."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.data import DRAWN, OTHER, RECORDED
from vlatool.gate.config import AnswersClaim
from vlatool.gate.result import ClaimResult, worst
from vlatool.gate.timed import Timed
from vlatool.measurement.agreement import SEQUENCE, Agreement, OutputAgreement
from vlatool.report import Measurement

KINDS = {
    RECORDED: "recorded observations with other bits",
    OTHER: "recorded observations under another instruction",
    DRAWN: "drawn observations",
    SEQUENCE: "observations in a row",
}


def examine(agreement: Agreement, timed: Timed, claim: AnswersClaim) -> ClaimResult:
    """Examine answers of the process that timed nothing, and those of all that did so far."""
    parts = [_steady(agreement, timed), *([] if claim.follows is None else [_follows(agreement, claim.follows)])]
    ordered = sorted(parts, key=lambda part: ("fail", "inconclusive", "pass").index(part[0]))
    measured = [
        Measurement("follows", followed.correlation, "1", samples=followed.samples,
                    note=f"least correlation with the baseline's answers: {followed.output}, {KINDS[followed.kind]}")
        for followed in _least(agreement.followed)
    ]  # fmt: skip
    verdict, words = worst(verdict for verdict, _ in parts), "; ".join(words for _, words in ordered)
    return ClaimResult("answers", verdict, words, tuple(measured))


def _steady(agreement: Agreement, timed: Timed) -> tuple[str, str]:
    """Judge answers to the same observation, with the same noise, at different times."""
    looked = agreement.looked + sum(pairs.looked for pairs in timed.pairs)
    strays = agreement.strays + sum(pairs.strays for pairs in timed.pairs)
    unsteady = agreement.unsteady + sum(pairs.unsteady for pairs in timed.pairs)
    if not strays:
        return "pass", f"{looked} answers are given again to the same observations, timed or not"
    words = f"{strays} of {looked} answers to the same observations differ when they are asked for again"
    if unsteady:
        return "inconclusive", f"{words}, and {unsteady} of the baseline's: the policy draws numbers of its own"
    return "fail", f"{words}, and none of the baseline's: it tells being timed from being used, or keeps what it saw"


def _follows(agreement: Agreement, least: float) -> tuple[str, str]:
    """Judge the output that follows the baseline's least."""
    judged = _least(agreement.followed)
    if not judged:
        return "inconclusive", "the baseline answers none of the observations that were drawn for it"
    (lowest,) = judged
    words = f"on observations that nobody could know, its {lowest.output} follows the baseline's with a correlation of "
    words += f"{lowest.correlation:.2f} ({lowest.samples} {KINDS[lowest.kind]}; allowed: from {least:.2f})"
    kept = lowest.correlation >= least
    return ("pass", words) if kept else ("fail", f"{words}; a policy that was trained anew may need another limit, or "
                                                 "none: answers: {follows: null}")  # fmt: skip


def _least(followed: Sequence[OutputAgreement]) -> list[OutputAgreement]:
    """Return the one of least correlation; none when there is none.

    Where there are recordings, observations that are drawn without any are far from what the policy is for, and say
    little of a copy in fewer bits.
    """
    near = [output for output in followed if output.kind != DRAWN] or list(followed)
    return sorted(near, key=lambda output: output.correlation)[:1]
