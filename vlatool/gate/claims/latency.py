"""The candidate is not slower than the baseline: by the median, by the mean, and on no observation at all."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

from pydantic import AliasChoices, Field, model_validator

from vlatool.files.printable import amount
from vlatool.gate.claim import Claim
from vlatool.gate.evidence import Evidence
from vlatool.gate.plan import Need, Plan
from vlatool.gate.timing_processes import Timed
from vlatool.gate.verdict import CONFIDENCE, Judgement, Outcome, Verdict
from vlatool.measurement.turns import CONFIRM
from vlatool.measures import Quantity
from vlatool.measures.latency import LATENCY_MEAN_RATIO, LATENCY_RATIO, ratio_at_threads
from vlatool.stats.sequential import ALPHA, INTERIM_ANALYSES, Decision, judge_jointly
from vlatool.stats.signed_rank import min_differences

STATISTICS = ((LATENCY_RATIO, "medians"), (LATENCY_MEAN_RATIO, "means of ratios"))
"""Statistics of a process: the median of its calls, and the mean over its observations, each by its median."""
MAX_PROCESSES = 1000
"""Number of processes beyond which it is not a useful advice that they would decide."""
AGREE = CONFIRM - 1
"""Pairs of ``CONFIRM`` that must be slow: between equal bundles, 19 of 20 are so once in 50,000 times."""
EXAMPLE = """
latency:
  margin: 0.05         # median and mean may be 5 % slower, no more
  worst: 0.5           # and no single observation by more than 50 %
  interim_analyses: [10, 20, 40]  # processes after which it is judged; most changes are decided at the first
  pairs: 150           # calls of each bundle in a process
  threads: 1           # those that the robot runs with
  # also_threads: [4]  # the same is claimed of the latency with so many threads
"""


class Latency(Claim):
    """The candidate is not slower than the baseline by more than a margin; both run side by side in fresh processes."""

    needs = frozenset({Need.TIMES})
    by_default = True
    order = 10
    example = EXAMPLE

    margin: float = Field(0.05, ge=0, le=10, description="largest slowdown of median and mean, a share (0.05 = 5 %)")
    interim_analyses: tuple[int, ...] = Field(
        INTERIM_ANALYSES,
        validation_alias=AliasChoices("interim_analyses", "looks"),
        description="processes after which it is judged; the last one ends it (looks in older files)",
    )
    pairs: int = Field(Plan.pairs, ge=30, description="calls of each bundle in a process")
    warmup: int = Field(Plan.warmup, ge=1, description="calls of each bundle before the first that counts")
    seconds: float = Field(
        Plan.seconds, gt=0, description="after which a process begins no further pair (at least 30 of them)"
    )
    worst: float = Field(0.5, ge=0, le=100, description="largest slowdown on any one observation, seen again and again")
    threads: int = Field(Plan.threads, ge=1, description="intra-op threads, for every claim; state those of the robot")
    also_threads: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (), description="further numbers of threads, for each of which the same is claimed of the latency"
    )
    engine: str = Field("", description="engine of the runtime; the one that each bundle was made for when empty")
    timeout: float = Field(
        Plan.timeout, gt=0, description="seconds after which a process that hangs ends, and the gate so"
    )

    @model_validator(mode="after")
    def _an_analysis_can_decide(self) -> Latency:
        after = self.interim_analyses
        least = min_differences(ALPHA / 2 / len(after)) if after else 1  # the median and the mean share it
        if not after or list(after) != sorted(set(after)) or after[0] < least:
            raise ValueError(f"interim_analyses must ascend and begin at {least} or later, or none of them can decide")
        return self

    def extend_plan(self, plan: Plan) -> Plan:
        """Let every process run with these threads and this engine."""
        options = {name: getattr(self, name) for name in ("engine", "threads", "also_threads", "warmup", "pairs")}
        return replace(super().extend_plan(plan), seconds=self.seconds, timeout=self.timeout, **options)

    def verdicts(self, evidence: Evidence) -> dict[str, Verdict]:
        """Examine the slowdown at ``threads``, and at each further number of threads."""
        found = {self.name(): self.examine(evidence)}
        for threads in self.also_threads:
            verdict = self.examine_timed(evidence.timed.at_threads(threads))
            measured = tuple(ratio_at_threads(one, threads) for one in verdict.measurements)
            found[f"{self.name()}, {threads} threads"] = replace(verdict, measurements=measured)
        return found

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the slowdown, process by process until it is decided."""
        return self.examine_timed(evidence.timed)

    def examine_timed(self, timed: Timed) -> Verdict:
        """Examine the slowdown in these processes."""

        def ratios(number: int) -> tuple[float, float]:
            pairs = timed.process(number)
            return pairs.log_ratio, pairs.mean_log_ratio

        decisions, _ = judge_jointly(ratios, len(STATISTICS), self.margin, self.interim_analyses)
        judged = [self._judged(*named, decision) for named, decision in zip(STATISTICS, decisions, strict=True)]
        found = Verdict.of(judged, slow=slow_observations(timed, self.worst))
        return replace(found, outcome=Outcome.FAIL) if found.facts["slow"] else found

    def _judged(self, quantity: Quantity, what: str, decision: Decision) -> Judgement:
        note = f"candidate over baseline, {what}, fresh processes with both, Hodges-Lehmann"
        low, high, count = decision.low, decision.high, decision.processes
        measured = quantity.measurement(
            decision.ratio, samples=count, low=low, high=high, confidence=CONFIDENCE, note=note
        )
        return Judgement(decision.verdict, what, measured, 1 + self.margin, facts={"decision": decision})

    def sentence(self, verdict: Verdict) -> str:
        """Return the observations that are slow, or else the statistic that decides; both statistics either way."""
        median, mean = (judged.facts["decision"] for judged in verdict.judgements)
        if slow := verdict.facts["slow"]:
            words = f"{len(slow)} of {median.processes} processes found an observation that is slower by more than "
            return f"{words}{self.worst:.0%} each time: {slow[0]}; {decision_words(median)}"
        if [judged.outcome is verdict.outcome for judged in verdict.judgements] != [False, True]:
            other = f"the mean over observations {slower(mean.ratio)} ({change(mean.low)} to {change(mean.high)})"
            return f"{decision_words(median)}; {other}"
        return f"the mean over observations is {decision_words(mean)}; the median alone is {slower(median.ratio)}"


def slow_observations(timed: Timed, margin: float) -> list[str]:
    """Return the observations, in words, on which the candidate is slower by more than a margin again and again."""
    limit = math.log1p(margin)
    return [pairs.slow_input for pairs in timed.pairs if sum(ratio > limit for ratio in pairs.slow) >= AGREE]


def decision_words(decision: Decision) -> str:
    """Return a decision in words: the ratio, what it lies between, and what the processes could have found."""
    words = f"{slower(decision.ratio)} ({change(decision.low)} to {change(decision.high)}, {decision.processes} "
    words += f"processes; allowed: {change(1 + decision.margin)}); "
    words += f"a slowdown of {decision.detectable:.1%} is found 95 times in 100"
    return f"{words}, {_advice(decision)}" if decision.verdict == Outcome.INCONCLUSIVE else words


def _advice(decision: Decision) -> str:
    """Return how many processes would decide; why none would where that is not a sensible number."""
    if decision.processes_needed <= MAX_PROCESSES:
        return f"about {amount(decision.processes_needed, 'process')} would decide"
    if (
        replace(decision, ratio=1.0).processes_needed > MAX_PROCESSES
    ):  # not even two equal bundles could be shown to be so
        return "this machine is too noisy to decide it: let nothing else run"
    return "it is too close to what is allowed for more processes to decide"


def slower(ratio: float) -> str:
    """Return ``4.0% slower`` or ``4.0% faster``."""
    return f"{ratio - 1:.1%} slower" if ratio >= 1 else f"{1 - ratio:.1%} faster"


def change(ratio: float) -> str:
    """Return ``+4.0%``; ``unbounded`` where too few processes give no bound."""
    return f"{ratio - 1:+.1%}" if 0 < ratio < math.inf else "unbounded"
