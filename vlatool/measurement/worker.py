"""The process that calls the policies: ``python -m vlatool.measurement.worker``.

It reads a ``WorkerJob``, opens and warms up, says ``Ready`` and waits for a line: its parent then begins to record
the board, and ends it when the worker says ``Timed`` and waits again. It says ``Progress`` meanwhile and in the
end ``Measured``, or what it raised. It imports what a robot imports, so that its memory is that of a robot's process.
"""

from __future__ import annotations

import gc
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.module_bundle import export_command
from vlatool.data import observations_for
from vlatool.errors import BundleError
from vlatool.machine.processes import die_with_parent
from vlatool.measurement import child
from vlatool.measurement.answers import Memory, expected_answers, measure_caching
from vlatool.measurement.clock_drift import canary_ms
from vlatool.measurement.duty_cycle import time_duty_cycle
from vlatool.measurement.interleaved import BLOCKS, Contestant, OnProgress, run_interleaved, unique_names
from vlatool.measurement.jobs import LatencyJob, WorkerJob
from vlatool.measurement.paced import run_paced
from vlatool.measurement.reach import reach_by_dtype
from vlatool.measurement.results import Benchmark, DutyMode, GraphEngine, Pace, Phase, PolicyRun
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program, Session
from vlatool.user_code import trust

OBSERVATIONS = 32
FIRST_RUN_S = 900.0
"""A benchmark is also for what no robot would wait for."""
EXTRA_S = 3.0
"""Seconds at most for the phases, and for the look at repeated observations."""
ACTIONS = 60
FEWEST = 5
ENCODE, REST = "encode observation", "decode action and the rest"


def main(stream: IO[str]) -> Benchmark:
    """Run the job that standard input names, and say on a stream how far it is."""
    die_with_parent()
    asked = child.read_job(WorkerJob)
    trust.restore(asked.named)

    def pause(message: child.Ready | child.Timed) -> None:
        child.say(message, stream)
        if not sys.stdin.readline():
            raise SystemExit("the process that started the measurement has ended")

    return run_job(
        asked.job,
        lambda what, share: child.say(child.Progress(what, share), stream),
        lambda: pause(child.Ready(os.getpid())),
        lambda: pause(child.Timed()),
    )


def run_job(
    job: LatencyJob, tell: OnProgress, wait: Callable[[], None] = lambda: None, timed: Callable[[], None] = lambda: None
) -> Benchmark:
    """Measure in this process.

    Args:
        tell: callback: what is being done, and the share that is done.
        wait: called when all is open and warm, before the first call that counts.
        timed: called after the last one.

    Raises:
        VlatoolError: what a bundle raises.
    """
    tell("opening", None)
    contestants = [open_policy(path, job) for path in job.bundles]
    unique_names(contestants)
    return measure(contestants, job, tell, wait, timed)


def measure(
    contestants: Sequence[Contestant],
    job: LatencyJob,
    tell: OnProgress,
    wait: Callable[[], None] = lambda: None,
    timed: Callable[[], None] = lambda: None,
) -> Benchmark:
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
    before = resource.getrusage(resource.RUSAGE_SELF)
    begun = time.monotonic()
    pace: Pace | None = None
    if job.rate:
        only = contestants[0]
        ticks = max(job.iterations, round(job.duration * job.rate))

        def between(share: float) -> None:
            if share * BLOCKS >= len(canaries):
                canaries.append(canary_ms())

        ticked = run_paced(only.policy, only.observations, job.rate, ticks, only.answers, tell, between=between)
        only.blocks, only.starts, pace = [ticked.response_ms], ticked.due_s, ticked.pace()
    else:
        run_interleaved(contestants, job.iterations, 0, tell, job.duration, lambda: canaries.append(canary_ms()))
    ended, after = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF)
    timed()
    return Benchmark(
        begun_s=begun,
        ended_s=ended,
        cpu_s=after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        wall_s=ended - begun,
        switches=after.ru_nivcsw - before.ru_nivcsw,
        canary_ms=tuple(canaries),
        policies=tuple(_policy(contestant, job, begun, pace, tell) for contestant in contestants),
    )


def open_policy(path: str, job: LatencyJob) -> Contestant:
    """Open a bundle in the runtime, or a torch source in eager torch; raises BundleError when it is neither."""
    bundle = Bundle.open(Path(path))
    manifest = bundle.manifest
    if manifest.graphs:
        policy = Policy.open(bundle, engine=job.engine, threads=job.threads, seed=0, traced=True)
        policy.warm_up(1, first_run_s=FIRST_RUN_S)
    elif "factory" in manifest.source:
        import torch

        from vlatool.module.torch_policy import torch_policy

        policy = torch_policy(bundle, seed=0)
        torch.set_num_threads(job.threads)  # as many as the engine gets
    else:
        raise BundleError(f"{bundle.path} has nothing to run.", f"export it first: {export_command(bundle.path)}")
    stage = str(manifest.made_by.get("stage", "policy")).rpartition(".")[2]
    name = {"torch_module": "torch eager", "onnx": "float32"}.get(stage, stage)
    return Contestant(name, bundle, policy, observations_for(bundle, OBSERVATIONS))


def _policy(contestant: Contestant, job: LatencyJob, begun: float, pace: Pace | None, tell: OnProgress) -> PolicyRun:
    policy = contestant.policy
    memory: Memory | None = None
    if contestant.answers is not None:
        tell("repeated against fresh observations", None)
        memory = measure_caching(policy, contestant.observations, EXTRA_S)
    phases: Sequence[Phase] = ()
    if job.phases and contestant.bundle.manifest.graphs:
        tell("timing the phases", None)
        phases = time_phases(policy, contestant.observations, EXTRA_S)
    duty: Sequence[DutyMode] = ()
    if job.duty_cycle:
        tell(f"timing calls at {job.duty_cycle:g} Hz, in a busy loop and alone", None)
        duty = time_duty_cycle(policy, contestant.observations, job.duty_cycle, job.duration)
    if job.reach and contestant.bundle.manifest.graphs:
        tell("timing a large product", None)
    return PolicyRun(
        name=contestant.name,
        blocks_ms=tuple(tuple(round(value, 6) for value in block) for block in contestant.blocks),
        at_s=tuple(round(start - begun, 6) for start in contestant.starts),
        engine=policy.engine,
        engines=tuple(_engines(policy)),
        record=policy.engine_record() if contestant.bundle.manifest.graphs else None,
        golden_error=policy.golden_error,
        golden_explained=policy.golden_explained,
        reach=_reach(policy, job.threads) if job.reach else {},
        answers=None if contestant.answers is None else contestant.answers.check(),
        memory=memory,
        phases=tuple(phases),
        pace=pace,
        duty=tuple(duty),
    )


def _reach(policy: Policy, threads: int) -> dict[str, float]:
    """Return what the policy's engine reaches in each dtype that its graphs compute in, as far as it can be asked."""
    graphs = policy.bundle.manifest.graphs.values()
    return reach_by_dtype(policy.engine, {dtype for graph in graphs for dtype in graph.precision}, threads)


def _engines(policy: Policy) -> Iterator[GraphEngine]:
    """Yield for each graph what runs it, as the session says."""
    for name, graph in policy.bundle.manifest.graphs.items():
        session = policy.program.sessions[name]
        shares = sorted(graph.precision.items(), key=lambda item: -item[1])
        yield GraphEngine(
            graph=name,
            engine=policy.engine,
            version=session.version() if hasattr(session, "version") else "",
            providers=getattr(session, "identity", str)()
            or ", ".join(dict(getattr(session, "providers", ())))
            or "CPU",
            computes_in=getattr(session, "precision", graph.compute or "float32"),
            macs_in=", ".join(f"{kind} {share:.1%}" for kind, share in shares),
        )


class _Timed:
    """A session that notes how long each run takes."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self.taken: list[float] = []

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        start = time.perf_counter_ns()
        outputs = self._session.run(feeds)
        self.taken.append((time.perf_counter_ns() - start) / 1e6)
        return outputs


def time_phases(policy: Policy, observations: Sequence[Mapping[str, Any]], seconds: float) -> list[Phase]:
    """Return the parts of an inference, in their order.

    Args:
        policy: left as it was.
        observations: observations, used in turns.
        seconds: time after which no further action begins, once ``FEWEST`` are timed.
    """
    sessions = {name: _Timed(session) for name, session in policy.program.sessions.items()}
    timed = Policy(policy.bundle, Program(policy.program.steps, sessions, seed=0), policy.engine)
    encoded: list[float] = []
    whole: list[float] = []
    end = time.monotonic() + seconds
    for number in range(ACTIONS):
        if number >= FEWEST and time.monotonic() > end:
            break
        start = time.perf_counter_ns()
        values = timed.encode(observations[number % len(observations)])
        encoded.append((time.perf_counter_ns() - start) / 1e6)
        timed.infer(values)
        whole.append((time.perf_counter_ns() - start) / 1e6)
    return _phases(whole, encoded, {name: session.taken for name, session in sessions.items()})


def _phases(whole: Sequence[float], encoded: Sequence[float], graphs: Mapping[str, Sequence[float]]) -> list[Phase]:
    actions = len(whole)
    sums = {ENCODE: np.array(encoded)}
    sums |= {name: np.array(taken).reshape(actions, -1).sum(1) for name, taken in graphs.items() if taken}
    sums[REST] = np.array(whole) - sum(sums.values())
    total = float(np.median(whole))
    phases = []
    for name, taken_ms in sums.items():
        calls, middle = len(graphs.get(name, whole)) // actions, float(np.median(taken_ms))
        phases.append(Phase(name, calls, round(middle / calls, 5), round(100 * middle / total, 1)))
    return phases


if __name__ == "__main__":
    answers = child.reserve_stdout()
    child.answer(lambda: main(answers), answers)
