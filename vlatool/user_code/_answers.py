"""Validation of the replies of a child that runs a user's code, which can write anything.

A policy shares its process with the function of vlatool that answers, and can answer in its place. It decides neither
the exit code nor what kind of error a person sees: an error of a child is one of its input, or of a package it lacks.
"""

from __future__ import annotations

import errno
import math
import signal
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vlatool import errors
from vlatool.errors import FallsShort, GraphError, InputError, MissingExtra, SourceError, VlatoolError
from vlatool.files.json import parse_json
from vlatool.files.limits import LIMITS_VARIABLE, limit
from vlatool.files.printable import MAX_CHARACTERS, file_of, truncate
from vlatool.machine.engine_calls import EngineCall, engine_crash
from vlatool.machine.processes import signal_name

CONNECTION_ERRORS = (errno.EPIPE, errno.ESHUTDOWN, errno.ECONNABORTED, errno.ECONNRESET, errno.ECONNREFUSED)
"""Errors of connections: none of a file, and to this program the sign that nobody reads it any more."""


MAX_MESSAGE = 2 * MAX_CHARACTERS
"""Characters of a message of a child, which may quote what foreign code says."""


MAX_LAST_LINE = 240
"""Characters of the last line that a child printed, for an error: its end says more than its beginning."""


@dataclass
class ChildState:
    """What is known of a child before it ended.

    Args:
        own: whether it runs vlatool's code alone.
        doing: what an engine does in it.
        told: what it told as its progress.
        said: the last line that it printed.
    """

    own: bool = False
    doing: EngineCall | None = None
    told: str = ""
    said: str = ""

    @property
    def words(self) -> str:
        """The end of the last line."""
        return self.said if len(self.said) <= MAX_LAST_LINE else f"...{self.said[-MAX_LAST_LINE:]}"


class ChildKilled(SourceError):
    """The process that runs a user's code was killed: another one may repeat the request."""


def read(line: bytes, about: str) -> dict[str, Any]:
    """Parse a message of a child."""
    try:
        message = parse_json(line)
    except ValueError as error:
        raise invalid_reply(about) from error
    if not isinstance(message, dict) or not _is_valid(message):
        raise invalid_reply(about)
    return message


def _is_valid(line: Mapping[str, Any]) -> bool:
    match line:
        case {"progress": [str(), None]} | {"warning": str()} | {"result": _} | {"memory": True}:
            return True
        case {"progress": [str(), int() | float() as share]}:
            return math.isfinite(share)
        case {"doing": None | [str(), str(), str()]}:
            return True
        case {"error": str(), "message": str(), "fix": str()} | {"raised": str(), "message": str(), "ours": bool()}:
            return isinstance(line.get("where", ""), str)
        case {"errno": int(number), "message": str(), "file": None | str()}:
            return number in errno.errorcode and number not in CONNECTION_ERRORS
    return False


def error_record(error: BaseException) -> dict[str, Any]:
    """Return an error as ``result`` raises it again; nothing for what code of a user, or a bug, raised."""
    if isinstance(error, VlatoolError):
        return {"error": type(error).__name__, "message": str(error.message), "fix": str(error.fix)}
    if isinstance(error, MemoryError):
        return {"memory": True}
    if isinstance(error, OSError) and error.errno in errno.errorcode and error.errno not in CONNECTION_ERRORS:
        return {"errno": error.errno, "message": str(error.strerror), "file": file_of(error) or None}
    return {}


def result(answer: Mapping[str, Any], about: str, *, own: bool = False) -> Any:
    """Return the result that an answer holds, or raise what it says that was raised.

    Args:
        about: name of the code that the child runs.
        own: the child runs vlatool's code alone: what fails in it is a bug of vlatool.

    Raises:
        InputError, MissingExtra, FallsShort: of the class that is named; any VlatoolError where ``own``.
        SourceError: for everything else that was raised, also by vlatool, which is named then; RuntimeError where
            ``own``.
        OSError, MemoryError: what the child met.
    """
    if "result" in answer:
        return answer["result"]
    if "memory" in answer:
        raise MemoryError
    message = plain(answer["message"])
    if "error" in answer:
        kind = ChildKilled if answer["error"] == ChildKilled.__name__ else getattr(errors, answer["error"], None)
        if isinstance(kind, type) and issubclass(kind, VlatoolError if own else InputError | MissingExtra | FallsShort):
            raise kind(truncate(answer["message"], MAX_MESSAGE), truncate(answer["fix"], MAX_MESSAGE))
        name = f"{answer['error']}: " if isinstance(kind, type) and issubclass(kind, VlatoolError) else ""
        raise SourceError(f"{about} failed: {plain(name)}{name and ' '}{message}", truncate(answer["fix"], MAX_MESSAGE))
    if "errno" in answer:
        raise OSError(answer["errno"], message, answer["file"] and truncate(answer["file"], MAX_MESSAGE))
    name = plain(answer["raised"])
    if own:
        raise RuntimeError(f"{about} failed in its process: {name}: {message}")
    if where := plain(answer.get("where", "")):
        said = f"{where} failed in the process that runs {about}: {name}: {message}."
        raise SourceError(said, "that is vlatool's own code: report it; VLATOOL_DEBUG=1 shows how it came there")
    if answer["ours"]:
        raise SourceError(
            f"{about}: the process that runs it failed: {name}: {message}.",
            "VLATOOL_DEBUG=1 shows where; report it where that is in vlatool",
        )
    raise exit_error(about, name, message)


def invalid_reply(about: str) -> SourceError:
    """Return the error for an invalid message of a child."""
    return SourceError(f"The process of the policy ({about}) answered nonsense.", "let it write to its own files alone")


def plain(text: str) -> str:
    """Return a text without control characters, truncated where it is very long."""
    text = truncate(text, MAX_MESSAGE)
    return "".join(character if unicodedata.category(character)[0] != "C" else " " for character in text).rstrip()


def exit_error(about: str, name: str, text: str) -> SourceError:
    """Return the error for code that raises something other than an ``Exception``."""
    if name == "SystemExit":
        return SourceError(f"{about} called sys.exit({text}).", "raise an exception that says what is wrong instead")
    return SourceError(f"{about} raised {name}{text and ': '}{text}.", "raise an Exception that says what is wrong")


def ending_error(status: bytes, about: str, last: ChildState) -> BaseException:
    """Return the error of a child that ended without an answer.

    Args:
        status: its exit code, as the server says it.
        about: name of the code that it ran.
    """
    text = status.decode("ascii", "replace").strip()
    if not text.lstrip("-").isdigit():
        return SourceError(f"{about}: the process that ran it was lost.", "run the command again")
    code = int(text)
    if code == -signal.SIGINT:
        return KeyboardInterrupt()
    if last.doing and code != -signal.SIGKILL:
        return _engine_error(code, last.doing, last.words)
    if code >= 0:
        return SourceError(
            f"{about} ended its process with exit code {code} before it was done (os._exit, or a library's exit).",
            "let it raise an exception that says what is wrong instead",
        )
    name = signal_name(code)
    if code == -signal.SIGKILL:
        return ChildKilled(
            f"{about}: the process that ran it was killed (SIGKILL) before it was done.",
            "where memory ran out, use a machine with more of it",
        )
    if last.own:
        said = f" It said last: {last.words}" if last.words else ""
        at = f" ({last.told})" if last.told else ""
        return GraphError(f"{about}{at} ended its process with {name}.{said}", "look for a library that crashes")
    return SourceError(f"{about} crashed its process ({name}) before it was done.", "look for a library that crashes")


def _engine_error(code: int, doing: EngineCall, said: str) -> GraphError:
    """Return the error of an engine that ended its process."""
    if code == -signal.SIGALRM:
        seconds = limit("engine_seconds")
        error = engine_crash(doing, f"was ended after {seconds:,} s, which the limit 'engine_seconds' allows,", said)
        return GraphError(error.message, f"if it needs longer: {LIMITS_VARIABLE}=engine_seconds={10 * seconds}")
    how = f"with {signal_name(code)}" if code < 0 else f"with exit code {code}"
    return engine_crash(doing, f"ended its process {how}", said)
