"""The candidate takes no more memory, and no more space on disk, than the baseline and a margin."""

from __future__ import annotations

from dataclasses import replace
from statistics import median

from vlatool.benchmark._probe import cold_start
from vlatool.bundle import Bundle
from vlatool.claims._found import Found
from vlatool.gate import GrowthClaim, LatencyClaim
from vlatool.report import Measurement
from vlatool.stage import Context

ROUNDING = 1e-9
PROBES = 3
"""Fresh processes that load each bundle once."""


def examine_memory(
    candidate: Bundle, baseline: Bundle, claim: GrowthClaim, how: LatencyClaim, context: Context
) -> Found:
    """Examine the peak memory of a fresh process that loads a bundle and infers once."""
    peaks: tuple[list[float], list[float]] = ([], [])
    for number in range(PROBES):
        context.tell("memory of each in fresh processes", number / PROBES)
        for bundle, found in zip((candidate, baseline), peaks, strict=True):
            found.append(cold_start(bundle.path, how.engine, how.threads, timeout=how.timeout)["peak_rss_mb"])
    mine, theirs = median(peaks[0]), median(peaks[1])
    note = f"load and a few inferences, median of {PROBES} fresh processes"
    return judged("memory", theirs, Measurement("peak_rss", mine, "MB", samples=PROBES, note=note), claim)


def examine_size(candidate: Bundle, baseline: Bundle, claim: GrowthClaim) -> Found:
    """Examine the bytes of the graphs."""
    mine, theirs = (bundle.graph_bytes / 1e6 for bundle in (candidate, baseline))
    return judged("size", theirs, Measurement("size", mine, "MB", note="graphs on disk"), claim)


def judged(name: str, baseline: float, measured: Measurement, claim: GrowthClaim) -> Found:
    """Hold a number that hardly varies against that of the baseline."""
    growth = measured.value / baseline - 1
    kept = growth <= claim.margin + ROUNDING
    words = f"{measured.value:.1f} {measured.unit}, the baseline {baseline:.1f} {measured.unit} ({growth:+.1%}; "
    words += f"allowed: {claim.margin:+.1%})"
    return Found(name, "pass" if kept else "fail", words, (measured,), (replace(measured, value=baseline),))
