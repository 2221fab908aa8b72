"""Hold our percentiles against those of MLPerf's loadgen, on the same calls.

    pip install mlcommons-loadgen
    python tests/validation/soak/loadgen_agrees.py

loadgen (single stream, performance only) calls a system that takes as long as a recorded trace says; the latencies that
loadgen itself logs are then given to ``vlatool.stats.percentiles``, in random order: loadgen takes calls for
independent, ours
counts calls that follow each other for less. Compared are the percentiles that loadgen prints, and its early-stopping
estimates, with ours. Of those, loadgen takes the call above the one that its condition asks for, which shows at the
99th percentile of few calls with a heavy tail.
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from pathlib import Path

import mlperf_loadgen as loadgen
import numpy as np

from vlatool.stats.percentiles import percentile

CALLS = 3000
TRACES = {
    "log-normal": lambda draw: draw.lognormal(-6.5, 0.3, CALLS),
    "bimodal": lambda draw: np.where(draw.random(CALLS) < 0.8, 1e-3, 3e-3) * draw.uniform(0.95, 1.05, CALLS),
    "Pareto": lambda draw: 8e-4 * (1 + draw.pareto(4, CALLS)),
}
SHOWN = {"50.00": 50.0, "90.00": 90.0, "95.00": 95.0, "99.00": 99.0}


def run(trace: np.ndarray, folder: Path) -> tuple[str, np.ndarray]:
    """Return loadgen's summary and the latencies that it logged, in seconds."""
    place = iter(trace)

    def issue(samples: list[loadgen.QuerySample]) -> None:
        end = time.perf_counter() + next(place)
        while time.perf_counter() < end:
            pass
        loadgen.QuerySamplesComplete([loadgen.QuerySampleResponse(sample.id, 0, 0) for sample in samples])

    settings = loadgen.TestSettings()
    settings.scenario = loadgen.TestScenario.SingleStream
    settings.mode = loadgen.TestMode.PerformanceOnly
    settings.min_query_count = settings.max_query_count = len(trace)
    settings.min_duration_ms = 0
    log = loadgen.LogSettings()
    log.log_output.outdir = str(folder)
    log.enable_trace = True
    system = loadgen.ConstructSUT(issue, lambda: None)
    library = loadgen.ConstructQSL(64, 64, lambda _: None, lambda _: None)
    loadgen.StartTestWithLogSettings(system, library, settings, log)
    loadgen.DestroyQSL(library)
    loadgen.DestroySUT(system)
    summary = (folder / "mlperf_log_summary.txt").read_text()
    logged = re.findall(r'"issue_start_ns":(\d+),"complete_ns":(\d+)', (folder / "mlperf_log_trace.json").read_text())
    return summary, np.array([int(end) - int(start) for start, end in logged]) / 1e9


def main() -> int:
    """Compare on every trace; 1 when p50, p90 or its bound differs by more than 2 %."""
    worst = 0.0
    for name, draw in TRACES.items():
        trace = draw(np.random.default_rng(0))
        with tempfile.TemporaryDirectory() as folder:
            summary, logged = run(trace, Path(folder))
        logged = np.random.default_rng(1).permutation(logged)
        told = dict(re.findall(r"([\d.]+) percentile latency \(ns\)\s*:\s*(\d+)", summary))
        for text, percent in SHOWN.items():
            ours, theirs = percentile(logged, percent).value, int(told[text]) / 1e9
            if percent <= 90:
                worst = max(worst, abs(ours / theirs - 1))
            print(f"{name} p{percent:g}: {1e3 * ours:.4f} ms, loadgen {1e3 * theirs:.4f} ms ({ours / theirs - 1:+.2%})")
        for text, stopped in re.findall(r"Early stopping ([\d.]+)th percentile estimate:\s*(\d+)", summary):
            ours, theirs = percentile(logged, float(text)).bound, int(stopped) / 1e9
            if float(text) == 90:
                worst = max(worst, abs(ours / theirs - 1))
            told_both = f"{1e3 * ours:.4f} ms, loadgen {1e3 * theirs:.4f} ms ({ours / theirs - 1:+.2%})"
            print(f"{name} p{float(text):g} bound: {told_both}")
        assert len(logged) == len(trace)
    print(f"largest difference of p50, p90 and the bound of p90: {worst:.2%}")
    return int(worst > 0.02)


if __name__ == "__main__":
    sys.exit(main())
