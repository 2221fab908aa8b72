"""Calls of fresh processes: one line of JSON in, one out; their errors are raised again in the caller.

What processes say to each other are the frozen dataclasses below, each as a mapping of its name to its fields.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO, Any, TypeVar

from vlatool import errors
from vlatool.errors import GateFailed, GraphError, VlatoolError
from vlatool.files.messages import from_json, to_json
from vlatool.machine.processes import NO_MEMORY, die_with_parent, signal_name
from vlatool.measurement.jobs import NO_LIMITS, Limits
from vlatool.measurement.process_limits import command, ran_out

REINSTALL = "see whether this Python runs vlatool at all: python -m vlatool doctor"
CRASHES = (
    "look for a library that crashes; another release of the engine may not: vlatool doctor lists what is installed"
)

T = TypeVar("T")
MAX_LAST_LINE = 240
"""Characters of the last line of a process that a signal ended: the end of an assertion says most."""


@dataclass(frozen=True)
class Progress:
    """What is being done, and the share that is done; None when it is not known."""

    what: str
    share: float | None


@dataclass(frozen=True)
class Ready:
    """All is open and warm in the process of this number, which waits for a line before the first call that counts."""

    process: int


@dataclass(frozen=True)
class Timed:
    """The last call that counts is over; the process waits for a line again."""


@dataclass(frozen=True)
class Result:
    """The last message of a process: what its job gave, as JSON values."""

    value: Any


@dataclass(frozen=True)
class Raised:
    """The last message of a process: the error of vlatool that it raised, by the name of its class."""

    kind: str
    message: str
    fix: str = ""


Message = Progress | Ready | Timed | Result | Raised
MESSAGES: dict[str, type[Message]] = {kind.__name__.lower(): kind for kind in (Progress, Ready, Timed, Result, Raised)}


def ask(
    module: str, job: Any, kind: type[T], about: str, timeout: float | None = None, limits: Limits = NO_LIMITS
) -> T:
    """Run a module of vlatool in a fresh process and return what it answers.

    Args:
        module: run as ``python -m``; it calls ``serve``.
        job: a dataclass, for its standard input.
        kind: type of its answer.
        about: subject of the question, for errors.
        timeout: seconds; endless when None.

    Raises:
        VlatoolError: what the process raised, of the same class; GraphError when it ended in another way or answered
            something else; GateFailed when it needed more memory than the limit.
    """
    try:
        done = subprocess.run(
            command(limits, module),
            input=json.dumps(to_json(job)) + "\n",
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout,
        )
    except subprocess.TimeoutExpired as error:
        raise GraphError(
            f"{about}: no result after {timeout:g} s, so the process was ended.",
            "see whether it hangs alone (vlatool benchmark); a gate allows more with latency: {timeout: SECONDS}",
        ) from error
    message = read_line(done.stdout.rstrip("\n").rpartition("\n")[2])
    if isinstance(message, Raised):
        raise error_of(message, limits)
    if done.returncode or not isinstance(message, Result):
        raise end_error(about, done.returncode, done.stderr, limits)
    return result_of(message, kind, about)


def result_of(message: Result, kind: type[T], about: str) -> T:
    """Return the result of a process; raises GraphError when it is not of the type."""
    try:
        return from_json(kind, message.value, "answer")
    except ValueError as error:
        raise GraphError(
            f"{about}: the process does not answer what it was asked: {error}.",
            "run it again; two versions of vlatool in one environment answer like that, too",
        ) from error


def read_line(text: str, check: Callable[[Any], Any] = lambda value: value) -> Message | None:
    """Return the message of a line; None for what an engine prints, and for a line that was not written to its end.

    Args:
        check: function called with its JSON values, and returns those that are read.
    """
    try:
        ((name, value),) = check(json.loads(text)).items()
        return from_json(MESSAGES[name], value)
    except (ValueError, RecursionError, AttributeError, LookupError):
        return None


def error_of(message: Raised, limits: Limits = NO_LIMITS, otherwise: type[VlatoolError] = GraphError) -> VlatoolError:
    """Return what a process says that it raised, as ``otherwise`` where that is not an error of vlatool."""
    if limits.memory_mb and any(sign in message.message for sign in NO_MEMORY):
        return too_large(limits)
    kind = getattr(errors, message.kind, None)
    raised = kind if isinstance(kind, type) and issubclass(kind, VlatoolError) else otherwise
    return raised(message.message, message.fix)


def end_error(about: str, code: int, log: str, limits: Limits, when: str = "in a fresh process") -> VlatoolError:
    """Return the error of a process that ended without a result, from its exit code and what it wrote to stderr."""
    if limits.memory_mb and (ran_out(limits) or any(sign in log for sign in NO_MEMORY)):
        return too_large(limits)
    if code == -signal.SIGKILL:
        return GraphError(
            f"{about}: the process was killed (SIGKILL) {when}, as it is when memory runs out.", "use a smaller policy"
        )
    if code < 0:
        last = log.strip().rpartition("\n")[2][-MAX_LAST_LINE:]
        said = f" It said last: {last}" if last else ""
        return GraphError(f"{about}: the process ended with {signal_name(code)} {when}.{said}", CRASHES)
    if code == 0:
        return GraphError(
            f"{about}: the process ended with exit code 0 {when}, before it was done.",
            "look for code that ends the process: an engine's or a library's exit",
        )
    last = (log.strip() or f"exit code {code}").splitlines()[-1]
    return GraphError(f"{about} cannot be run in a fresh process: {last}", REINSTALL)


def too_large(limits: Limits, seen: str = "") -> GateFailed:
    """Return the error of a policy that needs more memory than the board leaves it; ``seen`` says how much."""
    return GateFailed(
        f"It does not fit: the process needs more than {limits.memory_mb:,.0f} MB of memory{seen}.",
        "quantize it, or see which boards it fits on: vlatool hwselect",
    )


def reserve_stdout() -> IO[str]:
    """Reserve standard output for replies and return it; other output goes to standard error from now on."""
    stream = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return stream


def say(message: Message, stream: IO[str] | None = None) -> None:
    """Write a message as one line of JSON; to standard output when no stream is given."""
    out = stream or sys.stdout
    out.write(json.dumps({type(message).__name__.lower(): to_json(message)}) + "\n")
    out.flush()


def read_job(kind: type[T]) -> T:
    """Return the job on standard input."""
    return from_json(kind, json.loads(sys.stdin.readline()))


def answer(give: Callable[[], Any], stream: IO[str] | None = None) -> None:
    """Say what a function returns, or the error of vlatool that it raises."""
    try:
        message: Message = Result(to_json(give()))
    except VlatoolError as error:
        message = Raised(type(error).__name__, error.message, error.fix)
    say(message, stream)


def serve(kind: type[T], run: Callable[[T], Any]) -> None:
    """Answer ``ask``: run the job on standard input; this process ends with the one that started it."""
    die_with_parent()
    answer(lambda: run(read_job(kind)))
