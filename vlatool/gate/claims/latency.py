"""The candidate is not slower than the baseline: by the median, by the mean, and on no observation at all."""

from __future__ import annotations

import math
from dataclasses import replace

from vlatool.gate.config import LatencyClaim
from vlatool.gate.result import CONFIDENCE, ClaimResult, worst
from vlatool.gate.timed import Timed
from vlatool.measurement.turns import CONFIRM
from vlatool.report import Measurement
from vlatool.stats.sequential import Decision, judge_jointly

STATISTICS = ("median", "mean")
"""Of the calls; of the observations, each the median of its calls."""
TOLD = (("latency_ratio", "medians"), ("latency_mean_ratio", "means of ratios"))
MOST = 1000
"""Processes beyond which it is no advice that they would decide."""
AGREE = CONFIRM - 1
"""Pairs of ``CONFIRM`` that must be slow: between equal bundles, 19 of 20 are so once in 50,000 times."""


def examine_all(timed: Timed, claim: LatencyClaim) -> list[ClaimResult]:
    """Examine the slowdown at the number of threads of ``timed``, and at each further one that the claim names."""
    results = [examine(timed, claim)]
    for threads in claim.also_threads:
        result = examine(timed.at_threads(threads), claim)
        measured = tuple(replace(number, name=f"{number.name}_{threads}_threads") for number in result.measurements)
        results.append(replace(result, claim=f"{result.claim}, {threads} threads", measurements=measured))
    return results


def examine(timed: Timed, claim: LatencyClaim) -> ClaimResult:
    """Examine the slowdown, process by process until it is decided."""

    def ratios(number: int) -> tuple[float, float]:
        pairs = timed.process(number)
        return pairs.log_ratio, pairs.mean_log_ratio

    decisions, processes = judge_jointly(ratios, len(STATISTICS), claim.margin, claim.interim_analyses)
    measured = tuple(
        Measurement(
            name, decision.ratio, "x", samples=len(processes), low=decision.low, high=decision.high,
            confidence=CONFIDENCE, note=f"candidate over baseline, {what}, fresh processes with both, Hodges-Lehmann",
        )
        for (name, what), decision in zip(TOLD, decisions, strict=True)
    )  # fmt: skip
    verdicts = [decision.verdict for decision in decisions]
    slow = slow_observations(timed, claim.worst)
    if slow:
        words = f"{len(slow)} of {len(processes)} processes found an observation that is slower by more than "
        words += f"{claim.worst:.0%} each time: {slow[0]}"
        return ClaimResult("latency", "fail", f"{words}; {sentence_of(decisions[0])}", measured)
    chosen = worst(verdicts)
    return ClaimResult("latency", chosen, reason_of(decisions, chosen), measured)


def slow_observations(timed: Timed, margin: float) -> list[str]:
    """Return the observations, in words, on which the candidate is slower by more than a margin again and again."""
    limit = math.log1p(margin)
    return [pairs.slow_input for pairs in timed.pairs if sum(ratio > limit for ratio in pairs.slow) >= AGREE]


def reason_of(decisions: list[Decision], verdict: str) -> str:
    """Return what decides in words: the median, and the mean where it is the one that fails or cannot decide."""
    middle, mean = decisions
    if middle.verdict == verdict or mean.verdict != verdict:
        other = f"the mean over observations {slower(mean.ratio)} ({change(mean.low)} to {change(mean.high)})"
        return f"{sentence_of(middle)}; {other}"
    return f"the mean over observations is {sentence_of(mean)}; the median alone is {slower(middle.ratio)}"


def sentence_of(decision: Decision) -> str:
    """Return a decision in words: the ratio, what it lies between, and what the processes could have found."""
    words = f"{slower(decision.ratio)} ({change(decision.low)} to {change(decision.high)}, {decision.processes} "
    words += f"processes; allowed: {change(1 + decision.margin)}); "
    words += f"a slowdown of {decision.detectable:.1%} is found 95 times in 100"
    return f"{words}, {_advice(decision)}" if decision.verdict == "inconclusive" else words


def _advice(decision: Decision) -> str:
    """Return how many processes would decide; why none would where that is no sensible number."""
    if decision.wanted <= MOST:
        return f"about {decision.wanted} processes would decide"
    if replace(decision, ratio=1.0).wanted > MOST:  # two equal bundles could not be told to be so
        return "this machine is too noisy to decide it: let nothing else run"
    return "it is too close to what is allowed for more processes to decide"


def slower(ratio: float) -> str:
    """Return ``4.0% slower`` or ``4.0% faster``."""
    return f"{ratio - 1:.1%} slower" if ratio >= 1 else f"{1 - ratio:.1%} faster"


def change(ratio: float) -> str:
    """Return ``+4.0%``; ``unbounded`` where too few processes give no bound."""
    return f"{ratio - 1:+.1%}" if 0 < ratio < math.inf else "unbounded"
