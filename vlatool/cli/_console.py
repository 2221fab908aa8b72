"""What every command does with the terminal: progress on stderr, results on stdout."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import typer

from vlatool.cli._document import document, note_written, put, report_document
from vlatool.errors import GateFailed, Inconclusive, OutputError, UsageError
from vlatool.files.directory_writer import write_directory
from vlatool.files.outputs import REPORT, refuse_inputs, refuse_replacing
from vlatool.files.printable import mask_passwords, one_line, printable
from vlatool.machine.host import cache_directory
from vlatool.report import REPORT as REPORT_FILE
from vlatool.report import Report
from vlatool.stage.base import Context, OnProgress
from vlatool.workers import PROCESSES, launcher, parse_workers

PLACES = ("-o", "--output", "--cache", "--junit", "--video")
"""Options that name a place to write to: paths are not recorded."""
REPEAT_S = 30.0
"""Seconds between plain lines that differ in their numbers alone."""


def command_line() -> str:
    """Return the command as a person would type it elsewhere: without passwords and folders of this machine."""
    words, shown = sys.argv[1:], ["vlatool"]
    for before, word in zip(["", *words], words, strict=False):
        name, sign, value = word.partition("=")
        if before in PLACES:
            shown.append(_without_folders(word))
        elif sign and name in PLACES:
            shown.append(f"{name}={_without_folders(value)}")
        elif word.startswith("-o") and not word.startswith("--"):
            shown.append(f"-o{_without_folders(word[2:])}" if word[2:] else word)
        else:
            shown.append(word)
    return shlex.join(map(mask_passwords, shown))


def _without_folders(path: str) -> str:
    """Return the last part of an absolute path, or of one that leaves the current directory."""
    return Path(path).name or path if os.path.isabs(path) or path.startswith(("..", "~")) else path


def default_workers() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def crew(workers: str | None) -> tuple[int, str]:
    """Return how many workers were asked for, 0 for as many as there is place for, and who starts them.

    Raises:
        UsageError: when it is none of what ``--workers`` takes.
        MissingExtra, TargetError: when there is nobody to compute: better before the work than in the midst of it.
    """
    if workers is None:
        return default_workers(), PROCESSES
    name, count = parse_workers(workers)
    launcher(name, count).check()
    return count or default_workers() if name == PROCESSES else count, name


@contextlib.contextmanager
def progress(workers: int = 1, launched_by: str = PROCESSES) -> Iterator[Context]:
    """Yield a context whose progress is shown on stderr: a live bar on a terminal, plain lines elsewhere."""
    common: dict[str, Any] = {"command": command_line(), "launcher": launched_by}
    if not sys.stderr.isatty():
        yield Context(_plain_lines(), workers, **common)
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def tell(what: str, share: float | None) -> None:
            text, whole = escape(one_line(what)), None if share is None else 1.0
            bar.update(task, description=text, total=whole, completed=share or 0.0)

        yield Context(tell, workers, **common)


def _plain_lines() -> OnProgress:
    """Write what is new at once, and only numbers that changed every ``REPEAT_S`` seconds."""
    last, told = "", 0.0

    def tell(what: str, share: float | None) -> None:
        nonlocal last, told
        kind, now = re.sub(r"[\d.,%]+", "", what), time.monotonic()
        if kind != last or now - told >= REPEAT_S:
            last, told = kind, now
            with contextlib.suppress(OSError):  # its reader is gone: no reason to stop
                typer.echo(f"... {one_line(what)}", err=True)

    return tell


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """Show vlatool's warnings on stderr, each as one sentence and once, however often a stage repeats it."""
    shown: set[str] = set()
    elsewhere = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, UserWarning):
            elsewhere(message, category, *where, **more)
        elif str(message) not in shown:
            shown.add(str(message))
            with contextlib.suppress(OSError, ValueError):
                typer.echo(f"warning: {printable(str(message))}", err=True)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = elsewhere


def refuse_existing(
    out: Path | None, force: bool, *inputs: str | os.PathLike[str] | None, kind: str | None = REPORT
) -> None:
    """Refuse an output that cannot be written before the work, not after it.

    Args:
        force: Whether what vlatool wrote there may be replaced.
        inputs: Files that the command reads.
        kind: What is written: only the same is replaced (None: whatever is there).

    Raises:
        OutputError: when it is, holds or lies in an input, exists (and not ``force``), or is not vlatool's to replace.
    """
    if out is None:
        return
    refuse_inputs(out, inputs)
    refuse_replacing(out, force=force, protected={"the cache": cache_directory()}, kind=kind)
    if not os.path.lexists(out):
        _refuse_unwritable(out)


def refuse_video(
    video: Path | None, force: bool, out: Path | None, inputs: Iterable[str | os.PathLike[str] | None]
) -> None:
    """Refuse a video that cannot be written before the work, not after it.

    Args:
        force: Whether one that vlatool wrote there may be replaced.
        out: The directory of the report.

    Raises:
        UsageError: when its suffix names no format, or it is in the directory of the report.
        MissingExtra: when nothing is installed that writes the format.
        OutputError: when it lies in an input, exists (and not ``force``), or cannot be written.
    """
    from vlatool.render.video import check_video

    if video is None:
        return
    if out is not None and out.absolute() in (video.absolute(), *video.absolute().parents):
        raise UsageError(
            f"--video {video} is in the output {out}, which appears whole or not at all.",
            "name a file beside the output",
        )
    refuse_inputs(video, inputs)
    check_video(video, force=force)


def file_or_none(named: str | None) -> str | None:
    """Return what names a file rather than a thing by its name, such as a profile."""
    return named if named and os.path.isfile(named) else None


def _refuse_unwritable(out: Path) -> None:
    """Refuse a place in which no directory can be made."""
    above = next(folder for folder in out.absolute().parents if folder.exists())
    if not above.is_dir():
        raise OutputError(f"Cannot write {out}: a part of the path is a file ({above}).", "choose another output")
    if not os.access(above, os.W_OK | os.X_OK):
        raise OutputError(f"Cannot write {out}: this user may not write to {above}.", "choose another output")


def show(
    report: Report,
    *,
    as_json: bool,
    out: Path | None = None,
    force: bool = False,
    raw: bool = False,
    unfinished: Sequence[Path] = (),
) -> None:
    """Print a report on stdout, write it to a directory where wanted, and exit with the verdict's code.

    Args:
        out: Directory for the report, in which ``force`` replaces one that exists; None for none.
        raw: Print raw samples, too, as JSON.
        unfinished: Folders of what is kept until the report is written.

    Raises:
        GateFailed: for the verdict ``fail``.
        Inconclusive: for the verdict ``inconclusive``.
    """
    from vlatool.render import write_reports

    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    report = replace(report, command=report.command or command_line(), created=report.created or now)
    if as_json:  # first, so that a full disk does not lose it
        document(report_document(report, raw=raw, file=out / REPORT_FILE if out else None))
    else:
        put(terminal_text(report))
    if out is not None:
        with write_directory(out, force=force) as draft:
            write_reports(report, draft)
    note_written(unfinished)
    if out is not None and not as_json:
        put(f"report: {out / 'report.html'}\n")
    raise_verdict(report)


def terminal_text(report: Report, *, brief: bool = False) -> str:
    """Return the report for this terminal: its width, its colours."""
    import shutil

    from vlatool.render.formats.terminal import TerminalRenderer

    color = sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    width = min(shutil.get_terminal_size((80, 24)).columns, 120)
    return TerminalRenderer(width, color, brief).render(_printable(report))


def _printable(value: Any) -> Any:
    """Return a report whose texts are safe to print on a terminal."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, (tuple, list)):
        return type(value)(_printable(item) for item in value)
    if isinstance(value, dict):
        return {_printable(name): _printable(item) for name, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        contents = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
        return replace(value, **_printable(contents))
    return value


MISSED_FIX = "change the policy, the options or the limit: each limit stands above with what was measured"
UNDECIDED_FIX = (
    "where samples are missing, measure more (--episodes, --samples, --iterations); where the reference fails, look at "
    "its wrapper and data first: vlatool verify; the report says which"
)


def raise_verdict(report: Report) -> None:
    """Raise for a verdict that is not good.

    Raises:
        GateFailed: for the verdict ``fail``.
        Inconclusive: for the verdict ``inconclusive``.
    """
    if report.verdict == "fail":
        raise GateFailed(report.summary[0] if report.summary else "The limits are not kept.", MISSED_FIX)
    if report.verdict == "inconclusive":
        raise Inconclusive(report.summary[0] if report.summary else "The samples cannot decide.", UNDECIDED_FIX)
