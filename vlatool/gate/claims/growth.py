"""The candidate takes no more memory, and no more space on disk, than the baseline and a margin."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from statistics import median

from vlatool.bundle.bundle import DIGEST, LOCATION, MANIFEST, Bundle
from vlatool.data import PLAYED, is_of_recording
from vlatool.files.ownership import LEDGER
from vlatool.gate.config import GrowthClaim, LatencyClaim
from vlatool.gate.inputs import MEMORY, Inputs
from vlatool.gate.result import ClaimResult
from vlatool.measurement.cold_start import cold_start
from vlatool.report import Measurement
from vlatool.stage.base import Context

ROUNDING = 1e-9
PROBES = 3
"""Fresh processes that load each bundle once."""
OBSERVATIONS = 16
"""Observations that such a process answers, beside the golden one."""
ABOUT = (MANIFEST, DIGEST, LEDGER, LOCATION, PLAYED, "recipe.yaml", "SIGNATURE",
         "reports/report.html", "reports/report.md", "reports/report.json", "reports/difference.json",
         "reports/smooth_quant.json", "reports/weights.json")  # fmt: skip
"""Files of a bundle that no robot needs, beside the golden one and recordings."""


def examine_memory(
    candidate: Bundle,
    baseline: Bundle,
    claim: GrowthClaim,
    how: LatencyClaim,
    context: Context,
    inputs: Inputs | None = None,
) -> ClaimResult:
    """Examine the peak memory of a fresh process that loads a bundle and infers on observations of all kinds.

    Args:
        candidate, baseline: Bundles.
        claim, how: What is claimed, and engine and threads.
        context: For progress.
        inputs: What they are called with, beside the golden observation; that alone when None.
    """
    peaks: tuple[list[float], list[float]] = ([], [])
    for number in range(PROBES):
        context.progress("memory of each in fresh processes", number / PROBES)
        with inputs.file(OBSERVATIONS, MEMORY, number) if inputs else contextlib.nullcontext() as path:
            for bundle, taken in zip((candidate, baseline), peaks, strict=True):
                probed = cold_start(bundle.path, how.engine, how.threads, timeout=how.timeout, observations=path)
                taken.append(probed.peak_rss_mb)
    mine, theirs = median(peaks[0]), median(peaks[1])
    note = f"load and some inferences, median of {PROBES} fresh processes"
    return judged("memory", theirs, Measurement("peak_rss", mine, "MB", samples=PROBES, note=note), claim)


def examine_size(candidate: Bundle, baseline: Bundle, claim: GrowthClaim) -> ClaimResult:
    """Examine the bytes of the graphs and assets."""
    mine, theirs = (deployed_bytes(bundle) / 1e6 for bundle in (candidate, baseline))
    return judged("size", theirs, Measurement("size", mine, "MB", note="graphs and assets on disk"), claim)


def deployed_bytes(bundle: Bundle) -> int:
    """Return the bytes of everything in a bundle that a robot may need, whether the manifest names it or not.

    Weights may lie in any file, so every file counts but those that are known for what else they are; and a recorded
    file that is a graph, or lies in the folder of one, counts whatever it is called: its weights may be there.
    """
    folders = tuple(graph.file.rpartition("/")[0] for graph in bundle.manifest.graphs.values())
    within = tuple(f"{folder}/" if folder else "" for folder in folders)
    opened = {name for name in bundle.manifest.files if name.startswith(within)}
    spared = {*ABOUT, bundle.manifest.golden, *filter(is_of_recording, bundle.manifest.files)} - opened
    files = (path for path in bundle.path.rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in files if path.relative_to(bundle.path).as_posix() not in spared)


def judged(name: str, baseline: float, measured: Measurement, claim: GrowthClaim) -> ClaimResult:
    """Hold a number that hardly varies against that of the baseline."""
    growth = measured.value / baseline - 1
    kept = growth <= claim.margin + ROUNDING
    words = f"{measured.value:.1f} {measured.unit}, the baseline {baseline:.1f} {measured.unit} ({growth:+.1%}; "
    words += f"allowed: {claim.margin:+.1%})"
    return ClaimResult(name, "pass" if kept else "fail", words, (measured,), (replace(measured, value=baseline),))
