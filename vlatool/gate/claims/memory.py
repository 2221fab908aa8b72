"""The candidate takes no more memory than the baseline and a margin."""

from __future__ import annotations

from statistics import median

from vlatool.gate.claims._growth import Growth
from vlatool.gate.evidence import Evidence
from vlatool.gate.inputs import MEMORY
from vlatool.gate.plan import Need
from vlatool.gate.verdict import Verdict
from vlatool.measurement.cold_start import cold_start
from vlatool.measures.resources import PEAK_RSS

PROBES = 3
"""Fresh processes that load each bundle once."""
OBSERVATIONS = 16
"""Observations that such a process answers, beside the golden one."""


class Memory(Growth):
    """The candidate does not take more memory than the baseline by more than a margin."""

    needs = frozenset({Need.COLD_STARTS})
    order = 40
    example = "\nmemory:\n  margin: 0.10         # peak memory of a fresh process\n"

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the peak of a fresh process that loads a bundle and infers on observations of all kinds."""
        plan, inputs = evidence.plan, evidence.inputs
        peaks: tuple[list[float], list[float]] = ([], [])
        for number in range(PROBES):
            evidence.context.progress("memory of each in fresh processes", number / PROBES)
            with inputs.file(OBSERVATIONS, MEMORY, number) as path:
                for bundle, taken in zip((evidence.candidate, evidence.baseline), peaks, strict=True):
                    probed = cold_start(bundle.path, plan.engine, plan.threads, timeout=plan.timeout, observations=path)
                    taken.append(probed.peak_rss_mb)
        mine, theirs = map(median, peaks)
        note = f"load and some inferences, median of {PROBES} fresh processes"
        return self.judge(PEAK_RSS.measurement(mine, samples=PROBES, note=note), theirs)
