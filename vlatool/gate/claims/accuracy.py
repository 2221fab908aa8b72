"""The candidate is not worse than the baseline on the same recorded observations, or in the same episodes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vlatool.accuracy.credibility import DECIDE, credibility
from vlatool.accuracy.losses import drop, losses
from vlatool.accuracy.moved import START
from vlatool.accuracy.paired import few_starts, repeated_starts
from vlatool.bundle.bundle import Bundle
from vlatool.data import read_recording, recordings_of
from vlatool.errors import DataError
from vlatool.evaluate.recorded import alone, run_recorded
from vlatool.gate.config import AccuracyClaim
from vlatool.gate.episodes import Episodes
from vlatool.gate.result import CONFIDENCE, ClaimResult, worst
from vlatool.report import Measurement, Row
from vlatool.stage.base import Context
from vlatool.stats.starts import distinct_starts, independent_starts
from vlatool.stats.success_sequential import exact_drop

MOST_SAMPLES = 100_000


@dataclass(frozen=True)
class _Drop:
    name: str
    words: str
    value: float
    low: float
    high: float
    samples: int
    baseline: tuple[Measurement, ...] = ()
    warnings: tuple[str, ...] = ()
    candidate: tuple[Measurement, ...] = ()
    starts: str = ""
    few: str = ""

    def verdict(self, allowed: float) -> str:
        if self.few:
            return "inconclusive"
        return "fail" if self.low > allowed else "pass" if self.high <= allowed else "inconclusive"

    def told(self, allowed: float) -> str:
        ends = " to ".join(f"{end:+.2%}" if math.isfinite(end) else "unbounded" for end in (self.low, self.high))
        words = f"{self.words} {self.value:+.2%} ({ends}, {self.samples} of them{self.starts}; allowed: {allowed:+.2%})"
        gap = abs(allowed - self.value)
        if self.verdict(allowed) != "inconclusive":
            return words
        if self.few:
            return f"{words}; {self.few}"
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            return f"{words}, of one episode alone, which says nothing of others"
        if gap:  # an interval narrows with the root of the number
            reach = (self.high - self.value) if self.value < allowed else (self.value - self.low)
            words += f", about {max(self.samples + 1, math.ceil(self.samples * (reach / gap) ** 2)):,} would decide"
        return words


def examine(
    candidate: Bundle,
    baseline: Bundle,
    claim: AccuracyClaim,
    context: Context,
    engine: str = "",
    episodes: Episodes | None = None,
) -> ClaimResult:
    """Examine the drop on recorded observations, and in the closed loop where episodes are asked for.

    Args:
        candidate, baseline: Each is run with its own statistics and vocabulary, and judged by its physical actions.
        claim: What is claimed.
        context: Progress and workers.
        engine: Of the runtime, that of the other claims; the one that each bundle was made for when empty.
        episodes: Those that other claims look at, too; its own when None.

    Raises:
        DataError: when there is neither.
    """
    drops: list[_Drop] = []
    if (data := data_of(baseline, claim)) is not None:
        drops.append(_recorded(candidate, baseline, data, context, engine))
    if claim.episodes:
        drops.append(_closed_loop(episodes or Episodes(candidate, baseline, claim, context, engine)))
    words = [lost.told(claim.max_drop) for lost in drops]
    measured = tuple(
        Measurement(lost.name, lost.value, "1", samples=lost.samples, low=finite(lost.low), high=finite(lost.high),
                    confidence=CONFIDENCE, note=lost.words.rstrip(":"))
        for lost in drops
    )  # fmt: skip
    measured += tuple(number for lost in drops for number in lost.candidate)
    baselines = tuple(number for lost in drops for number in lost.baseline if number.name in DECIDE)
    trust = credibility(Row("baseline", "baseline", measurements=baselines), "the baseline")
    verdict = "inconclusive" if trust.fails else worst(lost.verdict(claim.max_drop) for lost in drops)
    unjudged_steps = [warning for lost in drops for warning in lost.warnings]
    reservations = [sentence.rstrip(".") for sentence in trust.sentences]
    return ClaimResult(
        "accuracy", verdict, "; ".join([*reservations, *words, *trust.warnings, *unjudged_steps]), measured, baselines
    )


def finite(bound: float) -> float | None:
    """Return a bound of an interval; None where there is none."""
    return bound if math.isfinite(bound) else None


def data_of(baseline: Bundle, claim: AccuracyClaim) -> Path | None:
    """Return the recorded observations that the claim is examined on, None for the closed loop alone.

    They are the gate's or the baseline's, never the candidate's: it would choose what it is judged on.

    Raises:
        DataError: when there are none and no episodes are asked for.
    """
    data = claim.data or recordings_of(baseline).evaluation
    if data is None and not claim.episodes:
        raise DataError(
            f"Accuracy is claimed, but the baseline {baseline.path} carries no evaluation data (those of the candidate "
            "do not count) and no episodes are asked for.",
            "name recorded data (accuracy: data) or episodes in the gate, or set accuracy: null",
        )
    return data


def _closed_loop(episodes: Episodes) -> _Drop:
    rows = episodes.rows
    before, after = (row.raw["success"] for row in rows)
    lost = sum(one > two for one, two in zip(before, after, strict=True))
    won = sum(one < two for one, two in zip(before, after, strict=True))
    starts = rows[0].raw[START]
    value, low, high = exact_drop(lost, won, len(before), CONFIDENCE, independent_starts(starts))
    own = tuple(number for number in rows[1].measurements if number.name == "success")
    words, begun = "more failed episodes:", f", {distinct_starts(starts)} distinct starts"
    return _Drop("success_drop", words, value, low, high, len(before), rows[0].measurements,
                 repeated_starts(rows[0]), own, begun, few_starts(rows[0]))  # fmt: skip


def _recorded(candidate: Bundle, baseline: Bundle, data: Path, context: Context, engine: str) -> _Drop:
    recording = read_recording(data, baseline.manifest.spec)
    indices = recording.spread(MOST_SAMPLES)
    action = baseline.manifest.spec.action
    mine, theirs = (run_recorded(bundle, recording, indices, engine, context) for bundle in (candidate, baseline))
    episodes = None if recording.episodes is None else recording.episodes[indices]
    expert = None if recording.actions is None else recording.actions[indices]
    baselines = tuple(alone(action, theirs, expert, episodes))
    if expert is None:  # nobody says what is right: the baseline's own actions are
        off, before = losses(action, mine, theirs), np.zeros(len(indices))
        words = "distance from the baseline's actions:"
    else:
        off, before = losses(action, mine, expert), losses(action, theirs, expert)
        words = "more distance from the expert's actions than the baseline has:"
    lost = drop(off, before, episodes, CONFIDENCE, action.kind == "discrete")
    return _Drop("recorded_drop", words, *lost, len(indices), baselines, recording.unjudged_steps)
