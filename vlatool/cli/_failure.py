"""What went wrong on a command line: its kind, its words, what to do, and the exit code."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import typer

from vlatool import registry
from vlatool.errors import VlatoolError
from vlatool.files.printable import file_of, message_of, reason_of

OK = 0
INPUT = 3
OUR_BUG = 70
INTERRUPT_CODE = 130
CLICK_EXCEPTION: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")
"""The base of usage errors: from the click inside typer, or the one that it imports, depending on its version."""
KEEPING = frozenset(("optimize", "export", "quantize"))
"""Commands whose finished stages stay in the cache when they are interrupted."""
NO_ROBOT = (
    "look at what it was asked for; where that is an observation, make the bundle otherwise: vlatool explain BUNDLE"
)
"""What helps at a command line where an answer is not finite."""
READABLE = "see that it is there, that this user may use it, and that its disk is well"
OF_SYSTEM = {
    errno.ENOENT: "check the path",
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space",
    errno.EMFILE: "raise the limit on open files (ulimit -n)",
    errno.EFBIG: "raise the limit on file sizes (ulimit -f)",
}
"""What helps where the operating system refuses something."""
TYPES = ("OSError", "MemoryError", "Interrupted", "Terminated", "InternalError")
"""Types of failures beside the classes of ``vlatool.errors``."""


@dataclass(frozen=True)
class Failure:
    """Why a command line did not end well.

    Args:
        type: A class of ``vlatool.errors``, or one of ``TYPES``.
        message: What was wrong.
        fix: What to do about it; may be empty.
        exit_code: What the process ends with.
    """

    type: str
    message: str
    fix: str
    exit_code: int

    def __str__(self) -> str:
        start = {"Interrupted": "", "InternalError": "internal error: "}.get(self.type, "error: ")
        return f"{start}{self.message}"


def failure(error: BaseException, words: Sequence[str]) -> Failure:
    """Return what an exception means to the person who typed these words."""
    if isinstance(error, CLICK_EXCEPTION):
        return _usage(error)
    if isinstance(error, VlatoolError):
        from vlatool.runtime.contract import ON_A_ROBOT

        fix = NO_ROBOT if error.fix.startswith(ON_A_ROBOT) else error.fix
        return Failure(type(error).__name__, error.message, fix, error.exit_code)
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        kept = "; finished stages are kept" if KEEPING.intersection(words) else ""
        return Failure("Interrupted", f"interrupted{kept}", "", INTERRUPT_CODE)
    if isinstance(error, BrokenPipeError):
        return Failure("OSError", "the reader of the output is gone.", "", OK)
    if isinstance(error, OSError):
        where = file_of(error) or ("standard output" if _printing(error) else "a file")
        fix = OF_SYSTEM.get(error.errno or 0, READABLE) if file_of(error) else ""
        return Failure("OSError", f"{where}: {error.strerror or error}.", fix, INPUT)
    if isinstance(error, MemoryError):
        return Failure("MemoryError", "out of memory.", "use a machine with more memory, or a smaller policy", INPUT)
    if isinstance(error, SystemExit):
        code = error.code if isinstance(error.code, int) else 1
        return Failure("Terminated", f"ended by signal {code - 128}." if code > 128 else "ended.", "", code)
    if blamed := registry.package_at_fault(error):
        return Failure("PluginError", *registry.plugin_failure(blamed, type(error).__name__, message_of(error)), INPUT)
    fix = "this is a bug in vlatool; run again with VLATOOL_DEBUG=1 and report the traceback"
    return Failure("InternalError", f"{type(error).__name__}: {message_of(error)}", fix, OUR_BUG)


def _printing(error: BaseException) -> bool:
    """Return whether an error is one of printing: it was raised in ``typer.echo``."""
    return [frame.f_code.co_name for frame, _ in traceback.walk_tb(error.__traceback__)][-1:] == ["echo"]


def _usage(error: Any) -> Failure:
    """Return click's reason for refusing a command line."""
    error.message = reason_of(error.message)
    context = getattr(error, "ctx", None)
    fix = f"{context.command_path} --help" if context else ""
    return Failure("UsageError", error.format_message(), fix, int(error.exit_code))
