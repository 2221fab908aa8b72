"""What the runtime adds to the engine's own run()."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from vlatool.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import UsageError
from vlatool.host import fingerprint
from vlatool.report import Measurement, Report, Row
from vlatool.runtime.policy import Policy
from vlatool.stage import Context, Measure
from vlatool.statistics import quantile_interval

if TYPE_CHECKING:
    from vlatool.profile import Profile


class Overhead(Measure):
    """Measure what ``infer`` adds to the engine's bare ``run()`` on the same inputs: pairs, in alternating order."""

    iterations: int = Field(2000, ge=50, description="pairs of calls")
    threads: int = Field(1, ge=1, description="intra-op threads")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The program is one graph that runs once, so that there is one bare call to compare with."""
        if source is not None and (len(source.manifest.program) != 1 or source.manifest.program[0].repeat != 1):
            raise UsageError("The overhead is measured on a policy of one graph that runs once for each inference.")

    def run(self, source: Bundle, context: Context) -> Report:
        """Return the median of the paired differences in microseconds."""
        self.check(source, None)
        policy = Policy.open(source, threads=self.threads, seed=0)
        observations = observations_for(source, 16)
        step = policy.program.steps[0]
        session = getattr(policy.program.sessions[step.graph], "_session")  # noqa: B009
        values = [policy.encode(observation) for observation in observations]
        feeds = [{name: encoded[value] for name, value in step.feeds.items()} for encoded in values]
        bare: list[float] = []
        whole: list[float] = []
        for index in range(self.iterations + 20):
            if index % 200 == 0:
                context.tell("measuring pairs", index / self.iterations)
            which = index % len(observations)
            for kind in (0, 1) if index % 2 else (1, 0):
                start = time.perf_counter_ns()
                if kind:
                    policy.infer(observations[which])
                else:
                    session.run(None, feeds[which])
                (whole if kind else bare).append((time.perf_counter_ns() - start) / 1e3)
        differences = np.array(whole[20:]) - np.array(bare[20:])
        return self._report(source, differences, float(np.median(bare[20:])))

    def _report(self, source: Bundle, differences: np.ndarray, bare_us: float) -> Report:
        value, low, high = quantile_interval(differences, 0.5)
        note = "infer() minus bare run(), paired"
        measurements = (
            Measurement("overhead_p50", value, "us", samples=len(differences), low=low, high=high, note=note),
            Measurement("bare_run_p50", bare_us, "us", samples=len(differences), note="engine alone"),
        )
        text = f"infer() adds {value:.1f} us (median) to a bare run() of {bare_us:.0f} us."
        row = Row(source.manifest.name, measurements=measurements, raw={"overhead_us": differences.tolist()})
        return Report("benchmark", f"Overhead of the runtime on {source.manifest.name}", summary=(text,), rows=(row,),
                      environment=fingerprint())  # fmt: skip
