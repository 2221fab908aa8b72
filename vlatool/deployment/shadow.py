"""The shadow run: a new bundle answers recorded observations in a child process, and no action reaches the robot."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.deployment.judge import SETTLING, Judge
from vlatool.errors import DataError, GateFailed, suggest
from vlatool.files.npz import open_npz
from vlatool.runtime.contract import allowed_mb
from vlatool.runtime.golden import load_goldens
from vlatool.runtime.policy import FIRST_RUN_S, Policy
from vlatool.runtime.probe import START_S, Job, ask, respond

CHILD = "from vlatool.deployment import shadow; shadow.main()"
MIN_RUNS = 2 * SETTLING
MAX_RUNS = 1_000_000


@dataclass(frozen=True)
class ShadowJob(Job):
    """Question to the child; see ``shadow_run``."""

    recording: Path | None = None
    runs: int = 100
    latency_ms: float = 0.0
    growth_mb: float = 0.0


def shadow_run(
    path: Path,
    *,
    recording: Path | None = None,
    runs: int = 100,
    latency_ms: float = 0.0,
    growth_mb: float = 0.0,
    engine: str = "",
    threads: int | None = None,
    first_run_s: float = FIRST_RUN_S,
    memory_mb: float | None = None,
) -> dict[str, Any]:
    """Let a bundle answer observations in a fresh process under limits.

    Args:
        path: bundle; its files are not verified here.
        recording: ``.npz`` with an array for each input, samples first; the golden observations when None.
        runs: number of inferences, at least ``MIN_RUNS``; the observations are repeated.
        latency_ms: limit on an inference in ms; none when 0.
        growth_mb: limit on the growth of the process in 10^6 bytes; none when 0.
        engine, threads, memory_mb: as for ``load``.
        first_run_s: seconds that one inference may take, and all of them beside their limit.

    Returns:
        ``runs``, ``p50_ms``, ``p95_ms``, ``worst_ms``, ``growth_mb``.

    Raises:
        GateFailed: when an action is not in the contract, not finite, too late, or the process grows.
        GraphError: when the process is ended by a limit or a signal.
        DataError: when there are no observations, or they do not fit.
        VlatoolError: what the bundle raises, of the same class.
    """
    allowed = allowed_mb(Bundle.open(path, verify=False).manifest, memory_mb)
    resolved = None if recording is None else recording.resolve()
    runs = max(runs, MIN_RUNS)
    seconds = START_S + first_run_s + 2 * runs * latency_ms / 1e3
    job = ShadowJob(path, engine, threads, first_run_s, allowed, seconds, resolved, runs, latency_ms, growth_mb)
    found = ask(CHILD, job)
    if found["violation"]:
        raise GateFailed(
            f"{path} fails its shadow run: {found['violation']}.",
            "repair the policy; or raise the limit of `vlatool deploy` that it names",
        )
    return found


def main() -> None:
    """Answer one question: the child's side."""
    respond(ShadowJob, _run)


def _run(job: ShadowJob) -> dict[str, Any]:
    bundle = Bundle.open(job.path)
    policy = Policy.open(bundle, engine=job.engine, threads=job.threads, seed=0, memory_mb=job.memory_mb)
    policy.limit_s = job.first_run_s
    samples = observations(bundle, job.recording)
    policy.infer(samples[0])
    judge = Judge(policy.spec, job.latency_ms, job.growth_mb)
    violation, times = judge_actions(policy, judge, itertools.islice(itertools.cycle(samples), job.runs))
    p50, p95 = np.percentile(times, (50, 95))
    return {"runs": len(times), "p50_ms": float(p50), "p95_ms": float(p95), "worst_ms": max(times),
            "growth_mb": judge.growth_mb, "violation": violation}  # fmt: skip


def judge_actions(policy: Any, judge: Judge, samples: Iterator[Mapping[str, Any]]) -> tuple[str, list[float]]:
    """Infer for each observation until one is wrong; return what is wrong, or nothing, and the times in ms."""
    times = []
    for observation in samples:
        start = time.perf_counter_ns()
        action = policy.infer(observation)
        times.append((time.perf_counter_ns() - start) / 1e6)
        if violation := judge.violation(action, times[-1]):
            return violation, times
    return "", times


def observations(bundle: Bundle, recording: Path | None) -> list[dict[str, Any]]:
    """Return observations of a recording, or the golden ones of a bundle.

    Raises:
        DataError: when there are none, or an input is missing.
    """
    if recording is not None:
        return _recorded(bundle.manifest.spec, recording)
    samples = [observation for observation, _, _ in load_goldens(bundle)]
    if not samples:
        raise DataError(f"{bundle.path} has no golden observation to run on.", "name a recording: --recording FILE.npz")
    return samples


def _recorded(spec: PolicySpec, path: Path) -> list[dict[str, Any]]:
    arrays = open_npz(path)
    for tensor in spec.inputs:
        if tensor.name not in arrays:
            raise DataError(
                f"{path} has no array '{tensor.name}'; {suggest(tensor.name, arrays)}.", "record every input"
            )
    count = min(len(arrays[tensor.name]) if arrays[tensor.name].ndim else 0 for tensor in spec.inputs)
    if not count:
        raise DataError(f"{path} has no samples.", "record some observations")
    return [{tensor.name: arrays[tensor.name][row] for tensor in spec.inputs} for row in range(count)]
