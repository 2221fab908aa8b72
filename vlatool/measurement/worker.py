"""The process that calls the policies: ``python -m vlatool.measurement.worker``.

It reads a job (one line of JSON), opens and warms up, says ``{"ready": PID}`` and waits for a line: whoever started it
begins to record the board then, and ends it when the worker says ``{"timed": true}`` and waits again. It says
``{"progress": [what, share]}`` meanwhile and ``{"result": ...}``, or what it raised, in the end. It imports what a
robot imports, so that its memory is that of a robot's process.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import BundleError
from vlatool.machine.processes import die_with_parent
from vlatool.measurement.answers import expected_answers, remembered
from vlatool.measurement.child import answer, answers_alone
from vlatool.measurement.clock_drift import canary_ms
from vlatool.measurement.interleaved import BLOCKS, Contestant, Tell, run_interleaved, unique_names
from vlatool.measurement.job import Job
from vlatool.measurement.paced import run_paced
from vlatool.measurement.phases import time_phases
from vlatool.runtime.policy import Policy
from vlatool.user_code import trust

OBSERVATIONS = 32
FIRST_RUN_S = 900.0
"""A benchmark is also for what no robot would wait for."""
EXTRA_S = 3.0
"""Seconds at most for the phases, and for the look at repeated observations."""


def main() -> dict[str, Any]:
    """Run the job that standard input names."""
    die_with_parent()
    asked = json.loads(sys.stdin.readline())
    trust.restore(asked.pop("named", ()))
    job = Job.from_dict(asked)

    def wait() -> None:
        _say({"ready": os.getpid()})
        _await()

    def timed() -> None:
        _say({"timed": True})
        _await()

    return {"result": run_job(job, lambda what, share: _say({"progress": [what, share]}), wait, timed)}


def _await() -> None:
    if not sys.stdin.readline():
        raise SystemExit("whoever started the measurement has gone")


_answers: IO[str] | None = None
"""Where answers go; standard output when None."""


def _say(line: dict[str, Any]) -> None:
    stream = _answers or sys.stdout
    stream.write(json.dumps(line) + "\n")
    stream.flush()


def run_job(
    job: Job, tell: Tell, wait: Callable[[], None] = lambda: None, timed: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Measure in this process.

    Args:
        job: What to measure.
        tell: What is being done, and the share that is done.
        wait: Called when all is open and warm, before the first call that counts.
        timed: Called after the last one.

    Returns:
        JSON values; ``policies`` has an entry for each bundle.

    Raises:
        VlatoolError: what a bundle raises.
    """
    tell("opening", None)
    contestants = [opened(path, job) for path in job.bundles]
    unique_names(contestants)
    return measure(contestants, job, tell, wait, timed)


def measure(
    contestants: Sequence[Contestant],
    job: Job,
    tell: Tell,
    wait: Callable[[], None] = lambda: None,
    timed: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Measure policies that are open."""
    for contestant in contestants:
        tell("warming up", None)
        if job.check:
            contestant.answers = expected_answers(contestant.policy, contestant.observations)
            contestant.observations = contestant.observations[: len(contestant.answers)]
        contestant.warm_up(job.warmup)
    gc.collect()
    gc.freeze()
    canaries: list[float] = []
    wait()
    before = _usage()
    begun = time.monotonic()
    paced = None
    if job.rate:
        only = contestants[0]
        ticks = max(job.iterations, round(job.duration * job.rate))

        def between(share: float) -> None:
            if share * BLOCKS >= len(canaries):
                canaries.append(canary_ms())

        seen = run_paced(only.policy, only.observations, job.rate, ticks, only.answers, tell, between=between)
        only.blocks, only.starts, paced = [seen.response_ms], seen.due_s, seen.to_dict()
    else:
        run_interleaved(contestants, job.iterations, 0, tell, job.duration, lambda: canaries.append(canary_ms()))
    ended = time.monotonic()
    found: dict[str, Any] = {"begun_s": begun, "ended_s": ended, "canary_ms": canaries, **_used(before, _usage())}
    timed()
    found["policies"] = [_policy(each, job, begun, tell) for each in contestants]
    found["policies"][0]["paced"] = paced
    return found


def opened(path: str, job: Job) -> Contestant:
    """Open a bundle through the runtime, or a torch source in eager torch.

    Raises:
        BundleError: when there is nothing to run.
    """
    bundle = Bundle.open(Path(path))
    manifest = bundle.manifest
    if manifest.graphs:
        policy = Policy.open(bundle, engine=job.engine, threads=job.threads, seed=0)
        policy.warm_up(1, first_run_s=FIRST_RUN_S)
    elif "factory" in manifest.source:
        from vlatool.module.torch_policy import torch_policy

        policy = torch_policy(bundle, seed=0)
        _set_torch_threads(job.threads)
    else:
        raise BundleError(f"{bundle.path} has nothing to run.")
    stage = str(manifest.made_by.get("stage", "policy")).rpartition(".")[2]
    name = {"torch_module": "torch eager", "onnx": "float32"}.get(stage, stage)
    return Contestant(name, bundle, policy, observations_for(bundle, OBSERVATIONS))


def _policy(contestant: Contestant, job: Job, begun: float, tell: Tell) -> dict[str, Any]:
    policy = contestant.policy
    found: dict[str, Any] = {
        "name": contestant.name,
        "blocks_ms": [[round(value, 6) for value in block] for block in contestant.blocks],
        "at_s": [round(start - begun, 6) for start in contestant.starts],
        "engine": policy.engine,
        "engines": _engines(policy),
        "golden_error": policy.golden_error,
    }
    if contestant.answers is not None:
        found["answers"] = contestant.answers.to_dict()
        tell("repeated against fresh observations", None)
        memory = remembered(policy, contestant.observations, EXTRA_S)
        found["memory"] = None if memory is None else {**vars(memory), "remembers": memory.remembers}
    if job.phases and contestant.bundle.manifest.graphs:
        tell("timing the phases", None)
        found["phases"] = time_phases(policy, contestant.observations, EXTRA_S)
    return found


def _engines(policy: Policy) -> list[dict[str, Any]]:
    """Return for each graph what runs it, as the session says."""
    found = []
    for name, graph in policy.bundle.manifest.graphs.items():
        session = policy.program.sessions[name]
        shares = sorted(graph.precision.items(), key=lambda item: -item[1])
        found.append(
            {
                "graph": name,
                "engine": policy.engine,
                "version": session.version() if hasattr(session, "version") else "",
                "providers": ", ".join(getattr(session, "providers", [])) or "CPU",
                "computes in": getattr(session, "precision", graph.compute or "float32"),
                "MACs in": ", ".join(f"{kind} {share:.1%}" for kind, share in shares),
            }
        )
    return found


def _usage() -> dict[str, float]:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "cpu_s": used.ru_utime + used.ru_stime,
        "switches": used.ru_nivcsw,
        "wall_s": time.monotonic(),
    }


def _used(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    return {name: after[name] - before[name] for name in before}


def _set_torch_threads(threads: int) -> None:
    """Give eager torch as many threads as the engine gets."""
    import torch

    torch.set_num_threads(threads)


if __name__ == "__main__":
    _answers = answers_alone()
    answer(main, _answers)
