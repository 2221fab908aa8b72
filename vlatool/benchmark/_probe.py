"""Run in a fresh process: load a bundle, infer once, and say how long it took and how much memory it needed.

``python -m vlatool.benchmark._probe BUNDLE ENGINE THREADS`` prints one line of JSON.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path
from typing import Any

from vlatool.benchmark._child import answer, ask


def cold_start(bundle: Path, engine: str, threads: int) -> dict[str, float]:
    """Probe a bundle in a fresh process.

    Returns:
        ``import_ms``, ``load_ms``, ``first_ms`` (the first inference after the load) and ``peak_rss_mb``
        (10^6 bytes).

    Raises:
        VlatoolError: what the bundle raises; GraphError when the process ends in another way.
    """
    found: dict[str, float] = ask("vlatool.benchmark._probe", (str(bundle), engine, str(threads)), "", str(bundle))
    return found


def main(arguments: list[str]) -> dict[str, float]:
    """Load and run once in this process."""
    start = time.perf_counter_ns()
    from vlatool.runtime import load
    from vlatool.runtime.policy import load_golden

    imported = time.perf_counter_ns()
    policy = load(arguments[0], engine=arguments[1], threads=int(arguments[2]), warmup=0)
    loaded = time.perf_counter_ns()
    golden: Any = load_golden(policy.bundle)
    ready = time.perf_counter_ns()
    if golden is not None:
        policy.infer(golden[0], noise=golden[1])
    done = time.perf_counter_ns()
    return {
        "import_ms": (imported - start) / 1e6,
        "load_ms": (loaded - imported) / 1e6,
        "first_ms": (done - ready) / 1e6,
        "peak_rss_mb": peak_rss_mb(),
    }


def peak_rss_mb(status: Path = Path("/proc/self/status")) -> float:
    """Return the largest resident set of this process so far in MB (10^6 bytes).

    ``ru_maxrss`` would do, but Linux lets a child inherit its parent's value; ``VmHWM`` belongs to the process alone.
    """
    for line in status.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


if __name__ == "__main__":
    answer(lambda: main(sys.argv[1:]))
