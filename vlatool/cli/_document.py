"""``--json``: one JSON document on standard output, whatever happens.

A command hands its result over (``document``); what else is printed meanwhile, by whatever code in this process or in a
child that inherits descriptor 1, goes to standard error. The document is written when the command has ended.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from vlatool.cli._failure import INPUT, Failure
from vlatool.files.resumable_work import remove_all_unused
from vlatool.report import Report, without_nan

FLAG = "--json"
EAGER_OPTIONS = ("--help", "--version")
"""Options whose text is the result of the command line that has them."""


class Output:
    """What ``--json`` leaves on standard output; ``printed`` takes the text of ``--help`` or ``--version``."""

    def __init__(self, printed: io.StringIO | None = None) -> None:
        self._printed = printed
        self._value: Any = None
        self._text = ""
        self._failure: Failure | None = None

    def take(self, value: Any, text: str = "") -> None:
        """Take a command's result, and the text that it is written as when that matters."""
        self._value, self._text = value, text

    def fail(self, failure: Failure) -> None:
        """Take what went wrong."""
        self._failure = failure

    def text(self) -> str:
        """Return the document: the result, the error, or the result with the error in it."""
        value = self._value
        if self._printed is not None and value is None and self._failure is None:
            value = {"text": self._printed.getvalue()}
        if self._failure is None:
            return self._text or json_text(value)
        return json_text({**(value if isinstance(value, dict) else {}), "error": asdict(self._failure)})


_now: list[Output] = []
"""The output of the command line that runs, when it asks for JSON."""
_lost: list[str] = []
"""Why results could not be printed."""
_kept: list[Path] = []
"""Folders of what is kept of a run until its result is printed."""


def document(value: Any, text: str = "") -> None:
    """Hand over a command's result: what JSON can say, in dataclasses too; NaN becomes null.

    It is written as ``text`` when there is one, else as ``json_text`` does.
    """
    if _now:
        _now[-1].take(value, text)
    else:
        typer.echo(text or json_text(value), nl=False)


def answer(as_json: bool, value: Any, lines: Iterable[str]) -> None:
    """Hand over a result for ``--json``, or print what a person reads of it."""
    if as_json:
        document(value)
        return
    for line in lines:
        typer.echo(line)


def json_text(value: Any) -> str:
    """Return a value as JSON in ASCII, which every terminal and every locale can print."""
    return json.dumps(without_nan(value), indent=1, allow_nan=False, default=str) + "\n"


def report_document(report: Report, *, raw: bool, file: Path | None) -> dict[str, Any]:
    """Return a report for standard output: without its raw samples, unless they are asked for.

    Args:
        file: The report that keeps them, None when none is written.
    """
    plain: dict[str, Any] = asdict(report)
    left_out = sum(len(series) for row in report.rows for series in row.raw.values())
    if raw or not left_out:
        return plain
    for row in plain["rows"]:
        row["raw"] = {}
    where = str(file.absolute()) if file else None
    ask = "--raw prints them" + ("" if file else "; -o DIRECTORY keeps them in report.json")
    return {**plain, "raw_samples": {"omitted": left_out, "file": where, "fix": ask}}


def wants_json(words: Sequence[str]) -> bool:
    """Return whether a command line asks for JSON, even one that is refused before its options are read."""
    return FLAG in words[: words.index("--") if "--" in words else len(words)]


@contextlib.contextmanager
def output(words: Sequence[str], *, for_good: bool) -> Iterator[Output | None]:
    """Keep standard output for the document, and write that at the end; do nothing where no JSON is asked for.

    Args:
        words: The command line.
        for_good: The process ends afterwards: what is printed after the document goes to standard error, too.
    """
    if not wants_json(words):
        yield None
        return
    at_once = any(word in EAGER_OPTIONS for word in words)
    printed = io.StringIO() if at_once else None
    stdout, kept = sys.stdout, _set_aside()
    sys.stdout = printed or sys.stderr
    _now.append(Output(printed))
    try:
        yield _now[-1]
    finally:
        _flush(sys.stdout)
        os.dup2(kept, 1)
        os.close(kept)
        sys.stdout = stdout
        put(_now.pop().text())
        if for_good:
            os.dup2(2, 1)


def _set_aside() -> int:
    """Send what is written to descriptor 1 to standard error; return a descriptor of what it was."""
    _flush(sys.stdout)
    kept = os.dup(1)
    os.dup2(2, 1)
    return kept


def _flush(stream: Any) -> None:
    """Flush the buffers of Python and C to where descriptor 1 leads now."""
    with contextlib.suppress(OSError, ValueError):
        stream.flush()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).fflush(None)


def put(text: str) -> None:
    """Print on standard output. A closed pipe is not an error; ``take_print_failure`` reports a full disk."""
    try:
        typer.echo(text, nl=False)
        sys.stdout.flush()
    except OSError as error:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            _lost.append(error.strerror or str(error))


def note_written(unfinished: Sequence[Path]) -> None:
    """Note that a result was written as far as files go: what was kept of its run goes once it is printed, too."""
    _kept.extend(unfinished)


def forget_kept(*, printed: bool) -> None:
    """Remove what was kept of runs whose results were written and printed; what was not printed can be asked again."""
    if printed:
        remove_all_unused(_kept)
    _kept.clear()


def take_print_failure() -> Failure | None:
    """Return why a result did not reach standard output since this was asked, None when all of it did."""
    if not _lost:
        return None
    reason = _lost[0]
    _lost.clear()
    fix = "make room where standard output is written to, and run it again"
    return Failure("OSError", f"the result cannot be printed: {reason}.", fix, INPUT)
