"""A gate claim: few actions are larger than a robot can take."""

from pydantic import Field

from vlatool.data import read_recording
from vlatool.evaluate.recorded import run_recorded
from vlatool.gate.claim import Claim
from vlatool.gate.plan import Need
from vlatool.gate.verdict import CONFIDENCE, Verdict, judge_interval
from vlatool.report import Measurement
from vlatool.stats.intervals import wilson


class Bounded(Claim):
    """Few of the candidate's actions are larger than a bound, on recorded observations."""

    needs = frozenset({Need.RECORDINGS})

    bound: float = Field(ge=0, description="largest element of an action")
    max_share: float = Field(0.05, ge=0, le=1, description="largest share of observations that lead to a larger one")

    def examine(self, evidence):
        """Count the observations that lead to a large action."""
        candidate = evidence.candidate
        recording = read_recording(evidence.recording_path, candidate.manifest.spec)
        indices = recording.spread(1000)
        actions = run_recorded(candidate, recording, indices, evidence.plan.engine, evidence.context)
        large, count = int((abs(actions) > self.bound).any(axis=(1, 2)).sum()), len(actions)
        low, high = wilson(large, count, CONFIDENCE)
        share = Measurement(
            "large_actions", large / count, "1", samples=count, low=low, high=high, confidence=CONFIDENCE
        )
        return Verdict.of([judge_interval(share, self.max_share, "share of large actions")])

    def sentence(self, verdict):
        """Return what was found, without a full stop."""
        (share,) = verdict.measurements
        words = f"{share.value:.1%} of {share.samples} actions are larger than {self.bound:g}"
        return f"{words} ({share.low:.1%} to {share.high:.1%}; allowed: {self.max_share:.1%})"
