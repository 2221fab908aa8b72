"""The candidate is not worse than the baseline on the same recorded observations, or in the same episodes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from vlatool.accuracy.credibility import DECIDE, Credibility, credibility
from vlatool.accuracy.losses import drop, losses
from vlatool.accuracy.success_comparison import few_starts, repeated_starts
from vlatool.bundle.bundle import Bundle
from vlatool.data import NamedRecording, read_recording
from vlatool.errors import DataError
from vlatool.evaluate.recorded import run_recorded, single_policy_measurements
from vlatool.gate.claim import Claim
from vlatool.gate.evidence import Evidence, recorded_data
from vlatool.gate.plan import Need, Plan
from vlatool.gate.verdict import CONFIDENCE, Judgement, Outcome, Reason, Verdict, judge_interval, samples_wanted
from vlatool.measures import Quantity, series
from vlatool.measures.actions import RECORDED_DROP
from vlatool.measures.success import SUCCESS, SUCCESS_DROP
from vlatool.report import Measurement, Row
from vlatool.stats.starts import distinct_starts, independent_starts
from vlatool.stats.success_sequential import exact_drop

MAX_SAMPLES = 100_000
EXAMPLE = """
accuracy:
  max_drop: 0.01       # one point, on the same samples (and episodes) as the baseline
  # data: data/evaluation.npz   # recorded observations and actions; the baseline's own when not given
  # map: {state: observation.state}   # names in the spec -> names in that data, where they differ
  # episodes: 200               # also closed-loop episodes, on paired seeds
  # policy: policy              # directory of the policy.yaml that names environment and tasks
"""


class Accuracy(Claim):
    """The candidate is not worse than the baseline by more than a drop, on the same data or the same episodes."""

    needs = frozenset({Need.RECORDINGS})
    by_default = True
    order = 20
    example = EXAMPLE

    max_drop: float = Field(0.01, ge=0, le=1, description="largest drop, a share (0.01 = 1 point)")
    data: Path | None = Field(None, description="recorded observations and actions; the baseline's own when not given")
    map: dict[str, str] = Field({}, description="name in the spec -> name in `data`, where they differ")
    episodes: int = Field(0, ge=0, description="closed-loop episodes over all tasks; 0 for recorded observations alone")
    policy: Path | None = Field(None, description="directory of the policy.yaml that names environment and tasks")

    def extend_plan(self, plan: Plan) -> Plan:
        """Name the recordings, and the episodes that other claims look at, too."""
        plan = replace(super().extend_plan(plan), data=self.data, names=self.map)
        plan = replace(plan, episodes=self.episodes, policy=self.policy)
        return replace(plan, needs=plan.needs | {Need.EPISODES}) if self.episodes else plan

    def check(self, baseline: Bundle, plan: Plan) -> None:
        """Refuse a claim that there is nothing to examine on."""
        if self.map and self.data is None:
            raise DataError(
                "The gate maps names of recorded data, and names no data.",
                "name it, too (accuracy: data), or leave the map out",
            )
        if recorded_data(baseline, plan) is None and not plan.episodes:
            raise DataError(
                f"Accuracy is claimed, but the baseline {baseline.path} carries no evaluation data (those of the "
                "candidate do not count) and no episodes are asked for.",
                "name recorded data (accuracy: data) or episodes in the gate, or set accuracy: null",
            )

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the drop on recorded observations, and in the closed loop where episodes are asked for.

        Each bundle is run with its own statistics and vocabulary, and judged by its physical actions.
        """
        parts: list[_Part] = []
        if evidence.recording_path is not None and evidence.recording is not None:
            parts.append(self._on_recordings(evidence, evidence.recording))
        if self.episodes:
            parts.append(self._in_episodes(*evidence.episodes))
        baselines = tuple(number for part in parts for number in part.baseline if number.name in DECIDE)
        trust = credibility(Row("baseline", "baseline", measurements=baselines), "the baseline")
        notes = [note for part in parts for note in part.notes]
        found = Verdict.of([part.judged for part in parts], baselines, trust=trust, notes=notes)
        measured = (*found.measurements, *(number for part in parts for number in part.candidate))
        outcome, reason = found.outcome, found.reason
        if trust.fails:
            outcome, reason = Outcome.INCONCLUSIVE, Reason.REFERENCE_FAILS
        return replace(found, outcome=outcome, reason=reason, measurements=measured)

    def _in_episodes(self, baseline: Row, candidate: Row) -> _Part:
        before, after = (row.raw[series.SUCCESS] for row in (baseline, candidate))
        lost = sum(one > two for one, two in zip(before, after, strict=True))
        won = sum(one < two for one, two in zip(before, after, strict=True))
        starts = baseline.raw[series.START]
        interval = exact_drop(lost, won, len(before), CONFIDENCE, independent_starts(starts))
        judged = self._held(SUCCESS_DROP, "more failed episodes:", interval, len(before), distinct_starts(starts))
        if few := few_starts(baseline):
            judged = replace(judged, outcome=Outcome.INCONCLUSIVE, reason=Reason.FEW_STARTS,
                             facts={**judged.facts, "few": few})  # fmt: skip
        own = tuple(number for number in candidate.measurements if number.name == SUCCESS.name)
        return _Part(judged, baseline.measurements, own, repeated_starts(baseline))

    def _on_recordings(self, evidence: Evidence, data: NamedRecording) -> _Part:
        action = evidence.baseline.manifest.spec.action
        recording = read_recording(data, evidence.baseline.manifest.spec).with_whole_chunks()
        indices = recording.spread(MAX_SAMPLES)
        mine, theirs = (
            run_recorded(bundle, recording, indices, evidence.plan.engine, evidence.context)
            for bundle in (evidence.candidate, evidence.baseline)
        )
        episodes = None if recording.episodes is None else recording.episodes[indices]
        expert = None if recording.actions is None else recording.actions[indices]
        if expert is None:  # nobody says what is right: the baseline's own actions are
            off, before = losses(action, mine, theirs), np.zeros(len(indices))
            title = "distance from the baseline's actions:"
        else:
            off, before = losses(action, mine, expert), losses(action, theirs, expert)
            title = "more distance from the expert's actions than the baseline has:"
        interval = drop(off, before, episodes, CONFIDENCE, action.kind == "discrete")
        judged = self._held(RECORDED_DROP, title, interval, len(indices))
        return _Part(
            judged, tuple(single_policy_measurements(action, theirs, expert, episodes)), notes=recording.unjudged_steps
        )

    def _held(
        self, quantity: Quantity, title: str, drop: tuple[float, float, float], samples: int, starts: int = 0
    ) -> Judgement:
        value, *ends = drop
        low, high = (end if math.isfinite(end) else None for end in ends)
        measured = quantity.measurement(
            value, samples=samples, low=low, high=high, confidence=CONFIDENCE, note=title.rstrip(":")
        )
        return judge_interval(measured, self.max_drop, title, starts=starts)

    def sentence(self, verdict: Verdict) -> str:
        """Return whether the baseline is a reference at all, each drop, and what a reader should know."""
        trust: Credibility = verdict.facts["trust"]
        reservations = (sentence.rstrip(".") for sentence in trust.sentences)
        drops = map(drop_words, verdict.judgements)
        return "; ".join([*reservations, *drops, *trust.warnings, *verdict.facts["notes"]])


class _Part(NamedTuple):
    """A drop, numbers for the rows of both, and what a reader should know."""

    judged: Judgement
    baseline: tuple[Measurement, ...]
    candidate: tuple[Measurement, ...] = ()
    notes: tuple[str, ...] = ()


def drop_words(judged: Judgement) -> str:
    """Return a drop in words, and what would decide where it is open."""
    drop = judged.measured
    if drop is None:
        return judged.title
    ends = " to ".join("unbounded" if end is None else f"{end:+.2%}" for end in (drop.low, drop.high))
    starts = f", {judged.facts['starts']} distinct starts" if judged.facts["starts"] else ""
    words = f"{judged.title} {drop.value:+.2%} ({ends}, {drop.samples} of them{starts}; allowed: {judged.limit:+.2%})"
    if judged.reason is Reason.FEW_STARTS:
        return f"{words}; {judged.facts['few']}"
    if drop.low is None or drop.high is None:
        return f"{words}, of one episode alone, which says nothing of others"
    more = samples_wanted(judged)
    return f"{words}, about {more:,} would decide" if more else words
