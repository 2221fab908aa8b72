"""What runs a benchmark on a machine, this one or another: ``python -m vlatool.measurement.agent``.

It starts the fresh processes of the cold starts and the worker that calls the policies, records the board while the
worker runs (in this process, so that no reader shares the worker's interpreter), and says what it found: a
``LatencyJob`` in; ``Progress`` out, in the end ``Measured`` or what was raised. It needs the standard library, numpy
and an engine.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, cast

from vlatool.errors import VlatoolError
from vlatool.files.messages import to_json
from vlatool.machine.host import before_run
from vlatool.measurement import child
from vlatool.measurement.cold_start import cold_start
from vlatool.measurement.interleaved import OnProgress
from vlatool.measurement.jobs import LatencyJob, Limits, WorkerJob
from vlatool.measurement.process_limits import choose_processors, command, control_group
from vlatool.measurement.results import Benchmark, PolicyRun
from vlatool.telemetry import Absent, Reader, Recorder, open_all
from vlatool.telemetry.process import ProcessReader
from vlatool.user_code import trust

PERIOD_S = 0.2
LOG_CHARACTERS = 4000
WORKER = "vlatool.measurement.worker"


def measure(job: LatencyJob, tell: OnProgress) -> Benchmark:
    """Measure on this machine.

    Raises:
        VlatoolError: what a bundle raises; GraphError when a process ends; GateFailed when it needs more memory than
            the limits leave.
    """
    limits = choose_processors(job.limits)
    if limits.memory_mb:
        tell("whether it fits into the memory", None)
        with control_group(limits) as limited:
            for path in job.bundles:
                start = cold_start(Path(path), job.engine, job.threads, limited)
                if start.peak_rss_mb > limited.memory_mb:  # pages of files that others have read count for no group
                    raise child.too_large(limited, f": {start.peak_rss_mb:,.0f} MB")
    host = before_run()
    free = replace(limits, memory_mb=0.0)  # the worker also holds observations and every sample
    measured = _run_worker(job, free, tell)
    policies = []
    for number, (path, policy) in enumerate(zip(job.bundles, measured.policies, strict=True)):
        if job.cold and policy.engines:
            tell("cold start of each in a fresh process", number / len(job.bundles))
            policy = _with_cold_starts(policy, Path(path), job, free)
        policies.append(policy)
    return replace(measured, host=host, policies=tuple(policies))


def _with_cold_starts(policy: PolicyRun, bundle: Path, job: LatencyJob, limits: Limits) -> PolicyRun:
    try:
        starts = tuple(cold_start(bundle, job.engine, job.threads, limits) for _ in range(job.cold))
    except VlatoolError as error:  # the latencies are measured, and stay
        return replace(policy, cold_error=error.message)
    return replace(policy, cold=starts)


def _run_worker(job: LatencyJob, limits: Limits, tell: OnProgress) -> Benchmark:
    about = ", ".join(job.bundles)
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log,
        _start(command(limits, WORKER), log) as worker,
        contextlib.ExitStack() as recording,
    ):
        recorder: Recorder | None = None
        _send(worker, json.dumps(to_json(WorkerJob(job, trust.named_folders()))))
        for line in cast(IO[str], worker.stdout):
            match child.read_line(line):
                case child.Progress(what, share):
                    tell(what, share)
                case child.Ready(process):
                    recorder = recording.enter_context(Recorder(_readers(process), PERIOD_S))
                    _send(worker)
                case child.Timed():
                    recording.close()
                    _send(worker)
                case child.Result() as result:
                    measured = child.result_of(result, Benchmark, about)
                    telemetry = recorder.summary if recorder else None
                    return replace(measured, telemetry=telemetry, log=_end_of(log))
                case child.Raised() as raised:
                    raise child.error_of(raised, limits)
        raise child.end_error(about, worker.wait(), _end_of(log), limits, "while it was measured")


def _end_of(log: IO[str]) -> str:
    """Return the last characters that the worker wrote to standard error."""
    log.seek(0)
    return log.read()[-LOG_CHARACTERS:]


def _send(worker: subprocess.Popen[str], line: str = "") -> None:
    """Send a line to the worker; one that has ended says so with its output."""
    stdin = cast(IO[str], worker.stdin)
    with contextlib.suppress(BrokenPipeError):
        stdin.write(line + "\n")
        stdin.flush()


@contextlib.contextmanager
def _start(words: list[str], log: IO[str]) -> Iterator[subprocess.Popen[str]]:
    """Start a process, and see to it that it ends with the block."""
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=log, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def _readers(worker: int) -> list[Reader | Absent]:
    """Return the readers of the board, and one of the worker instead of that of this process."""
    readers = [reader for reader in open_all() if _name(reader) != ProcessReader.name]
    return [*readers, ProcessReader.open(number=worker)]


def _name(reader: Reader | Absent) -> str:
    return reader.reader if isinstance(reader, Absent) else reader.name


def main() -> Benchmark:
    """Run the job that standard input names."""
    return measure(child.read_job(LatencyJob), lambda what, share: child.say(child.Progress(what, share)))


if __name__ == "__main__":
    child.answer(main)
