"""What runs a benchmark on a machine, this one or another: ``python -m vlatool.measurement.agent``.

It starts the fresh processes of the cold starts and the worker that calls the policies, records the board while the
worker runs (in this process, so that no reader shares the worker's interpreter), and says what it found: one line of
JSON in (the job), lines of JSON out (``progress``, in the end ``result`` or what was raised). It needs the standard
library, numpy and an engine.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, cast

from vlatool.errors import VlatoolError
from vlatool.machine.host import before_run
from vlatool.measurement.child import answer, ended, message, raise_said, too_large
from vlatool.measurement.cold_start import cold_start
from vlatool.measurement.interleaved import Tell
from vlatool.measurement.job import Job, Limits
from vlatool.measurement.limited import chosen, command, grouped
from vlatool.telemetry import Absent, Recorder, open_all
from vlatool.telemetry.process import ProcessReader
from vlatool.user_code import trust

PERIOD_S = 0.2
LOG_CHARACTERS = 4000
WORKER = "vlatool.measurement.worker"


def measure(job: Job, tell: Tell) -> dict[str, Any]:
    """Measure on this machine.

    Returns:
        JSON values: ``job``, ``host`` (with ``processors_busy`` before the run), ``begun_s``, ``ended_s``,
        ``canary_ms``, ``cpu_s``, ``wall_s``, ``switches``, ``policies`` (one for each bundle), ``telemetry`` and
        ``log``, the end of what the worker wrote to standard error.

    Raises:
        VlatoolError: what a bundle raises; GraphError when a process ends; GateFailed when it needs more memory than
            the limits leave.
    """
    limits = chosen(job.limits)
    if limits.memory_mb:
        tell("whether it fits into the memory", None)
        with grouped(limits) as limited:
            for path in job.bundles:
                start = cold_start(Path(path), job.engine, job.threads, limited)
                if start["peak_rss_mb"] > limited.memory_mb:  # pages of files that others have read count for no group
                    raise too_large(limited, f": {start['peak_rss_mb']:,.0f} MB")
    host = before_run()
    free = replace(limits, memory_mb=0.0)  # the worker also holds observations and every sample
    found = _run_worker(job, free, tell)
    for number, (path, policy) in enumerate(zip(job.bundles, found["policies"], strict=True)):
        if job.cold and policy["engines"]:
            tell("cold start of each in a fresh process", number / len(job.bundles))
            try:
                policy["cold"] = [cold_start(Path(path), job.engine, job.threads, free) for _ in range(job.cold)]
            except VlatoolError as error:  # the latencies are measured, and stay
                policy["cold_error"] = error.message
    return {"job": {**job.to_dict(), "bundles": len(job.bundles)}, "host": host, **found}


def _run_worker(job: Job, limits: Limits, tell: Tell) -> dict[str, Any]:
    about = ", ".join(job.bundles)
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log,
        _started(command(limits, WORKER), log) as worker,
        contextlib.ExitStack() as recording,
    ):
        recorder: Recorder | None = None
        _answer(worker, json.dumps({**job.to_dict(), "named": trust.named_so_far()}))
        for text in cast(IO[str], worker.stdout):
            line = message(text)
            if "progress" in line:
                tell(*line["progress"])
            elif "ready" in line:
                recorder = recording.enter_context(Recorder(_readers(int(line["ready"])), PERIOD_S))
                _answer(worker)
            elif "timed" in line:
                recording.close()
                _answer(worker)
            elif "result" in line:
                found: dict[str, Any] = line["result"]
                told = recorder.recorded.to_dict() if recorder else None
                return {**found, "telemetry": told, "log": _end_of(log)}
            else:
                raise_said(line, limits)
        code = worker.wait()
        raise ended(about, code, _end_of(log), limits, "while it was measured")


def _end_of(log: IO[str]) -> str:
    """Return the last characters that the worker wrote to standard error."""
    log.seek(0)
    return log.read()[-LOG_CHARACTERS:]


def _answer(worker: subprocess.Popen[str], line: str = "") -> None:
    """Send a line to the worker; one that has ended says so with its output."""
    stdin = cast(IO[str], worker.stdin)
    with contextlib.suppress(BrokenPipeError):
        stdin.write(line + "\n")
        stdin.flush()


@contextlib.contextmanager
def _started(words: list[str], log: IO[str]) -> Iterator[subprocess.Popen[str]]:
    """Start a process, and see to it that it ends with the block."""
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=log, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def _readers(worker: int) -> list[Any]:
    """Return the readers of the board, and one of the worker in the place of that of this process."""
    found = [each for each in open_all() if _name(each) != ProcessReader.name]
    return [*found, ProcessReader.open(number=worker)]


def _name(each: Any) -> str:
    return str(each.reader if isinstance(each, Absent) else each.name)


def main() -> dict[str, Any]:
    """Run the job that standard input names."""
    job = Job.from_dict(json.loads(sys.stdin.readline()))

    def tell(what: str, share: float | None) -> None:
        sys.stdout.write(json.dumps({"progress": [what, share]}) + "\n")
        sys.stdout.flush()

    return {"result": measure(job, tell)}


if __name__ == "__main__":
    answer(main)
