"""Run in a fresh process: load a bundle, infer, and say how long each part took and how much memory it needed.

``python -m vlatool.measurement.cold_start`` reads a ``ColdStartJob`` and answers with a ``ColdStart``.
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.measurement.child import ask, serve
from vlatool.measurement.jobs import NO_LIMITS, ColdStartJob, Limits

FURTHER_CALLS = 5
"""Inferences after the first: an engine's arena may grow with the second."""
PARTS = {
    "interpreter": "Python",
    "imported": "numpy and runtime",
    "engine": "engine library",
    "loaded": "graphs and weights",
    "first": "first inference",
    "more": "later inferences",
}


@dataclass(frozen=True)
class ColdStart:
    """What a fresh process took.

    Args:
        start_ms: from the start of the process until its first line of Python.
        import_ms: time to import numpy and the runtime.
        engine_ms: time to import the engine's library.
        load_ms: to verify and load the graphs.
        first_ms: time of the first inference after loading.
        total_ms: from the start of the process to the first action.
        peak_rss_mb: memory at most (10^6 bytes).
        rss_mb: part (of ``PARTS``) -> what the process holds once that part is done.
    """

    start_ms: float
    import_ms: float
    engine_ms: float
    load_ms: float
    first_ms: float
    total_ms: float
    peak_rss_mb: float
    rss_mb: dict[str, float]


def cold_start(
    bundle: Path,
    engine: str,
    threads: int,
    limits: Limits = NO_LIMITS,
    timeout: float | None = None,
    observations: Path | None = None,
) -> ColdStart:
    """Probe a bundle in a fresh process, which may take ``timeout`` seconds.

    Args:
        observations: file of observations (``save_drawn``) to infer on after the golden one.

    Raises:
        VlatoolError: what the bundle raises; GraphError when the process ends in another way, or takes longer.
    """
    further = "" if observations is None else str(observations)
    job = ColdStartJob(str(bundle), engine, threads, time.monotonic_ns(), further)
    return ask("vlatool.measurement.cold_start", job, ColdStart, str(bundle), timeout, limits)


def run(job: ColdStartJob) -> ColdStart:
    """Load and run in this process."""
    begun = time.monotonic_ns()
    rss = {"interpreter": resident_mb()}
    from vlatool.bundle.bundle import Bundle
    from vlatool.runtime import load
    from vlatool.runtime.engine import DEFAULT_ENGINE

    imported = time.monotonic_ns()
    rss["imported"] = resident_mb()
    named = job.engine or Bundle.open(job.bundle, verify=False).manifest.engine  # load verifies what it opens
    _import_engine(named or DEFAULT_ENGINE)
    ready = time.monotonic_ns()
    rss["engine"] = resident_mb()
    policy = load(job.bundle, engine=job.engine, threads=job.threads, warmup=0)
    loaded = time.monotonic_ns()
    rss["loaded"] = resident_mb()
    observation, noise = _observation(policy)
    before = time.monotonic_ns()
    policy.infer(observation, noise=noise)
    acted = time.monotonic_ns()
    rss["first"] = resident_mb()
    for _ in range(FURTHER_CALLS):
        policy.infer(observation, noise=noise)
    if job.observations:
        _infer_on(policy, Path(job.observations))
    rss["more"] = resident_mb()
    return ColdStart(
        start_ms=(begun - job.begun_ns) / 1e6,
        import_ms=(imported - begun) / 1e6,
        engine_ms=(ready - imported) / 1e6,
        load_ms=(loaded - ready) / 1e6,
        first_ms=(acted - before) / 1e6,
        total_ms=(acted - job.begun_ns) / 1e6,
        peak_rss_mb=peak_rss_mb(),
        rss_mb=rss,
    )


def _observation(policy: Any) -> tuple[Any, Any]:
    """Return the golden observation with its noise, or a recorded or synthetic one where there is no golden."""
    from vlatool.runtime.golden import load_golden

    golden = load_golden(policy.bundle)
    if golden is not None:
        return golden[0], golden[1]
    from vlatool.data import observations_for

    return observations_for(policy.bundle, 1)[0], None


def _infer_on(policy: Any, path: Path) -> None:
    """Infer on the observations of a file; one that no action can be had for has had its memory all the same."""
    from vlatool.data import read_drawn
    from vlatool.errors import GraphError

    for drawn in read_drawn(path):
        try:
            policy.infer(drawn.observation)
        except GraphError:
            policy.reset()


def _import_engine(name: str) -> None:
    """Import the library of an engine by asking for its version; what it needs is told when the graphs are opened."""
    from vlatool import registry

    engine: Any = registry.load("engines", name)
    engine.version()


def resident_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the resident set of this process in MB (10^6 bytes)."""
    resident = _line_mb(status, "VmRSS:")
    return peak_rss_mb(status) if resident is None else resident


def peak_rss_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the largest resident set of this process so far in MB (10^6 bytes).

    ``ru_maxrss`` would do, but Linux lets a child inherit its parent's value; ``VmHWM`` belongs to the process alone.
    """
    peak = _line_mb(status, "VmHWM:")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6 if peak is None else peak


def _line_mb(status: Path, name: str) -> float | None:
    lines = status.read_text(encoding="utf-8").splitlines()
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(name)), None)


if __name__ == "__main__":
    serve(ColdStartJob, run)
