"""A question to a fresh process: one line of JSON in, one out, and its errors come back as they were raised."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

from vlatool import errors
from vlatool.errors import GraphError, VlatoolError
from vlatool.processes import environment

SAID = "vlatool error"


def ask(module: str, arguments: Sequence[str], line: str, about: str, timeout: float | None = None) -> dict[str, Any]:
    """Run a module of vlatool in a fresh process and return what it answers.

    Args:
        module: Run as ``python -m``; its last act is ``answer``.
        arguments: Of the command.
        line: For its standard input.
        about: What is asked about, for errors.
        timeout: Seconds; endless when None.

    Raises:
        VlatoolError: what the process raised, of the same class; GraphError when it ended in another way.
    """
    command = [sys.executable, "-m", module, *arguments]
    try:
        done = subprocess.run(
            command, input=line, capture_output=True, text=True, check=False, timeout=timeout, env=environment()
        )
    except subprocess.TimeoutExpired as error:
        raise GraphError(f"{about}: no result after {timeout:g} s.") from error
    told = done.stdout.splitlines()[-1:]
    found: dict[str, Any] = json.loads(told[0]) if told and told[0].startswith("{") else {}
    if SAID in found:
        raised = getattr(errors, str(found[SAID]), GraphError)
        raise raised(str(found["message"]), str(found["fix"]))
    if done.returncode or not found:
        last = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
        raise GraphError(f"{about} cannot be run in a fresh process: {last}")
    return found


def answer(give: Callable[[], dict[str, Any]]) -> None:
    """Print what a function returns as one line of JSON, or what it raised."""
    try:
        found = give()
    except VlatoolError as error:
        found = {SAID: type(error).__name__, "message": error.message, "fix": error.fix}
    sys.stdout.write(json.dumps(found) + "\n")
