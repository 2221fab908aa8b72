"""A question to a fresh process: one line of JSON in, one out, and its errors come back as they were raised."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

from vlatool import errors
from vlatool.errors import GateFailed, GraphError, VlatoolError
from vlatool.measurement.job import Limits
from vlatool.measurement.limited import command, ran_out

SAID = "vlatool error"
NO_MEMORY = (
    "MemoryError",
    "bad_alloc",
    "ailed to allocate",
    "out of memory",
    "annot allocate memory",
    "Memory allocation",
)
"""What Python, C++ and the engines say when a limit is reached; a control group kills instead."""


def ask(
    module: str,
    arguments: Sequence[str],
    line: str,
    about: str,
    timeout: float | None = None,
    limits: Limits = Limits(),  # noqa: B008
) -> dict[str, Any]:
    """Run a module of vlatool in a fresh process and return what it answers.

    Args:
        module: Run as ``python -m``; its last act is ``answer``.
        arguments: Of the command.
        line: For its standard input.
        about: What is asked about, for errors.
        timeout: Seconds; endless when None.
        limits: Of the process.

    Raises:
        VlatoolError: what the process raised, of the same class; GraphError when it ended in another way; GateFailed
            when it needed more memory than the limit.
    """
    try:
        done = subprocess.run(
            command(limits, module, arguments),
            input=line,
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
    found = message(done.stdout.rstrip("\n").rpartition("\n")[2])
    raise_said(found, limits)
    if done.returncode or not found:
        raise ended(about, done.returncode, done.stderr, limits)
    return found


def message(text: str) -> dict[str, Any]:
    """Return a line of JSON; nothing for what an engine prints, and for a line that its process did not live to end."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def raise_said(
    found: Mapping[str, Any],
    limits: Limits = Limits(),  # noqa: B008
    otherwise: type[VlatoolError] = GraphError,
) -> None:
    """Raise what a process said that it raised, ``otherwise`` when that is no error here; nothing when it did not."""
    if SAID not in found:
        return
    told = str(found.get("message", ""))
    if limits.memory_mb and any(sign in told for sign in NO_MEMORY):
        raise too_large(limits)
    kind = getattr(errors, str(found[SAID]), None)
    raised = kind if isinstance(kind, type) and issubclass(kind, VlatoolError) else otherwise
    raise raised(told, str(found.get("fix", "")))


def ended(about: str, code: int, log: str, limits: Limits, when: str = "in a fresh process") -> VlatoolError:
    """Return the error of a process that ended without a result, from its exit code and what it wrote to stderr."""
    if limits.memory_mb and (ran_out(limits) or any(sign in log for sign in NO_MEMORY)):
        return too_large(limits)
    if code == -signal.SIGKILL:
        return GraphError(
            f"{about}: the process was killed (SIGKILL) {when}, as it is when memory runs out.", "use a smaller policy"
        )
    if code < 0:
        return GraphError(f"{about}: the process ended with {signal_name(code)} {when}.")
    if code == 0:
        return GraphError(f"{about}: the process ended with exit code 0 {when}, before it was done.")
    last = (log.strip() or f"exit code {code}").splitlines()[-1]
    return GraphError(f"{about} cannot be run in a fresh process: {last}")


def signal_name(code: int) -> str:
    """Return the name of the signal that ended a process, from its negative exit code."""
    try:
        return signal.Signals(-code).name
    except ValueError:  # a real-time signal has no name
        return f"signal {-code}"


def too_large(limits: Limits, seen: str = "") -> GateFailed:
    """Return the error of a policy that needs more memory than the board leaves it; ``seen`` says how much."""
    return GateFailed(
        f"It does not fit: the process needs more than {limits.memory_mb:,.0f} MB of memory{seen}.",
        "quantize it, or see which boards it fits on: vlatool hwselect",
    )


def answers_alone() -> IO[str]:
    """Return standard output for answers alone: what anybody else prints goes to standard error from now on."""
    stream = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return stream


def answer(give: Callable[[], dict[str, Any]], stream: IO[str] | None = None) -> None:
    """Print what a function returns as one line of JSON, or what it raised."""
    try:
        found = give()
    except VlatoolError as error:
        found = {SAID: type(error).__name__, "message": error.message, "fix": error.fix}
    out = stream or sys.stdout
    out.write(json.dumps(found) + "\n")
    out.flush()
