"""The first run of a bundle in a child process with limits: what hangs, crashes or eats memory does so there.

``vlatool.load(path, probe=True)`` and ``vlatool inspect --probe``; needs the standard library and what a robot has.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from vlatool import errors
from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, VlatoolError
from vlatool.files.messages import from_json, to_json
from vlatool.machine.processes import NO_MEMORY, python_code, signal_name
from vlatool.runtime.contract import allowed_mb
from vlatool.runtime.policy import FIRST_RUN_S, Policy

START_S = 60.0
"""What the child may take beside its first run: Python, the engine's library, opening the graphs on a slow board."""
CHILD = "from vlatool.runtime import probe; probe.main()"


@dataclass(frozen=True)
class Job:
    """Question to the child; see ``probe``."""

    path: Path
    engine: str
    threads: int | None
    first_run_s: float
    memory_mb: float
    seconds: float


T = TypeVar("T", bound=Job)


def probe(
    path: Path,
    *,
    engine: str = "",
    threads: int | None = None,
    first_run_s: float = FIRST_RUN_S,
    memory_mb: float | None = None,
) -> dict[str, Any]:
    """Open a bundle and run its golden observation once, in a fresh process under limits.

    Args:
        path: The bundle; its files are not verified here.
        engine, threads: As for ``load``.
        first_run_s: Seconds that the inference may take; opening the graphs may take ``START_S`` more.
        memory_mb: Private writable memory of the process in 10^6 bytes (``RLIMIT_DATA``); 2,000 and eight times the
            size of the graphs when None.

    Returns:
        ``memory_mb`` that was allowed, ``peak_rss_mb`` of the process, ``golden_error`` and ``golden_chunk_error``
        (None without a golden file), ``golden_tolerances`` of both, and ``refused``: message and fix with which
        ``load`` refuses the bundle on this machine for one of them, or None.

    Raises:
        GraphError: when the process is ended by a limit or a signal; says how to raise the limit.
        VlatoolError: what the bundle raises, of the same class.
    """
    allowed = allowed_mb(Bundle.open(path, verify=False).manifest, memory_mb)
    job = Job(path, engine, threads, first_run_s, allowed, START_S + first_run_s)
    return {"memory_mb": allowed, **ask(CHILD, job)}


def ask(code: str, job: Job) -> dict[str, Any]:
    """Run code, which calls ``respond``, in a fresh process under the limits of a job, and return what it answers.

    Raises:
        GraphError: when the process is ended by a limit or a signal; says how to raise the limit.
        VlatoolError: what the code raises, of the same class.
    """
    try:
        done = subprocess.run(
            python_code(code), input=json.dumps(to_json(job)), timeout=job.seconds,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise _too_long(job.path, job.seconds) from None
    return _answer(job.path, done, job.memory_mb)


def main() -> None:
    """Answer one question: the child's side."""
    respond(Job, _run)


def respond(kind: type[T], run: Callable[[T], dict[str, Any]]) -> None:
    """Run the job on standard input under its limits, and print the answer."""
    job = from_json(kind, json.loads(sys.stdin.readline()))
    size = int(job.memory_mb * 1e6)
    resource.setrlimit(resource.RLIMIT_DATA, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    seconds = math.ceil(job.seconds * len(os.sched_getaffinity(0)))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))  # should the parent not live to end this process
    try:
        answer = run(job)
    except VlatoolError as error:
        answer = {"error": type(error).__name__, "message": error.message, "fix": error.fix}
    except MemoryError:
        answer = {"error": "GraphError", "message": "MemoryError", "fix": ""}
    sys.stdout.write("\n" + json.dumps(answer) + "\n")


def _run(job: Job) -> dict[str, Any]:
    policy = Policy.open(Bundle.open(job.path), engine=job.engine, threads=job.threads, seed=0, memory_mb=job.memory_mb)
    policy.replay_golden(1, job.first_run_s)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = None
    try:
        policy.check_golden()
    except GraphError as error:
        refused = (error.message, error.fix)
    return {
        "golden_error": policy.golden_error, "golden_chunk_error": policy.golden_chunk_error,
        "golden_tolerances": policy.golden_tolerances, "refused": refused, "peak_rss_mb": peak * 1024 / 1e6,
    }  # fmt: skip


def _answer(path: Path, done: subprocess.CompletedProcess[str], allowed: float) -> dict[str, Any]:
    """Return the child's answer, or raise its error."""
    answer: dict[str, Any] = {}
    with contextlib.suppress(ValueError):
        answer = json.loads(done.stdout.rstrip("\n").rpartition("\n")[2])
    message = str(answer.get("message", "")) or done.stderr[-2000:]
    if ("error" in answer or done.returncode) and any(sign in message for sign in NO_MEMORY):
        raise GraphError(
            f"{path}: the first run needs more than {allowed:,.0f} MB of memory.",
            "allow more with load(..., memory_mb=...) or vlatool inspect --probe --memory MB",
        )
    if "error" in answer:
        kind = getattr(errors, str(answer["error"]), GraphError)
        raise kind(message, str(answer.get("fix", "")))
    if done.returncode < 0:
        raise GraphError(
            f"{path}: the first run ends its process with {signal_name(done.returncode)}.", "do not load it"
        )
    if done.returncode or not answer:
        last = (message.strip() or f"exit code {done.returncode}").splitlines()[-1]
        raise GraphError(
            f"{path} cannot be run in a process of its own: {last}",
            f"read what it says, and see what is installed: {shlex.quote(sys.executable)} -m pip list",
        )
    return answer


def _too_long(path: Path, seconds: float) -> GraphError:
    return GraphError(
        f"{path}: no first action after {seconds:g} s, so the process was ended.",
        "allow a slow policy more with load(..., first_run_s=...) or vlatool inspect --probe --first-run SECONDS",
    )
