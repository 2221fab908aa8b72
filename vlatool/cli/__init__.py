"""The command line: parse, call, render; no logic."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.cli._commands import ROOT_OPTIONS, Commands
from vlatool.cli._console import plain_warnings
from vlatool.cli._document import Output, forget_kept, output, take_print_failure
from vlatool.cli._failure import CLICK_EXCEPTION, INTERRUPT_CODE, Failure, failure
from vlatool.errors import refuse_two_distributions
from vlatool.files.printable import printable
from vlatool.machine.host import LEROBOT_PYTHON, UNNORM_KEY
from vlatool.machine.version import VERSION
from vlatool.user_code import children, trust

app = typer.Typer(
    name="vlatool",
    cls=Commands,
    help="Make a trained robot policy run, fast and safely, on the board that the robot carries.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
GRAPHS_PRELOAD = ("numpy.random", "onnx", "onnxruntime", "vlatool.stage._child", "vlatool.quantize.static_int8")
MODULES_PRELOAD = ("torch", "onnx", "onnxscript", "onnxruntime", "vlatool.export.onnx", "vlatool.stage._child")
TRAINING_METHOD = "qat"


def _trust(folders: list[Path]) -> list[Path]:
    for folder in folders:
        trust.trust(folder)
    return folders


def _other_python(path: Path | None) -> Path | None:
    if path is not None:
        os.environ[LEROBOT_PYTHON] = str(path)
    return path


def _unnorm_key(key: str | None) -> str | None:
    if key is not None:
        os.environ[UNNORM_KEY] = key
    return key


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"vlatool {VERSION}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    trusted: Annotated[
        list[Path] | None,
        typer.Option(
            "--trust",
            callback=lambda folders: _trust(folders or []),
            help="let a bundle run the code in this policy directory, now and later, until something in it changes",
        ),
    ] = None,
    python: Annotated[
        Path | None,
        typer.Option(
            "--python",
            callback=_other_python,
            help="Python that has the library of a checkpoint, such as LeRobot's; also $VLATOOL_LEROBOT_PYTHON",
        ),
    ] = None,
    unnorm_key: Annotated[
        str | None,
        typer.Option(
            "--unnorm-key",
            callback=_unnorm_key,
            help="dataset whose statistics a checkpoint of several acts in; also $VLATOOL_UNNORM_KEY",
        ),
    ] = None,
) -> None:
    """Make a trained robot policy run, fast and safely, on the board that the robot carries."""


def _open_standard_files() -> None:
    """Open what the shell has closed (``2>&-``): files that are opened later would take the numbers, and the prints."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))


def _flush_streams() -> None:
    """Discard what cannot be written: a full disk or a closed pipe does not change the exit code at the very end."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _say(text: str, fix: str = "") -> None:
    """Print on stderr, if it is still open."""
    with contextlib.suppress(OSError, ValueError):
        typer.echo(f"{printable(text)}\n  fix: {printable(fix)}" if fix else printable(text), err=True)


def _with_root_options_first(arguments: list[str]) -> list[str]:
    """Move ``--trust DIR`` and ``--python PATH`` to the front: they are options of every command."""
    first: list[str] = []
    rest: list[str] = []
    words = iter(arguments)
    for word in words:
        if word == "--":
            rest += [word, *words]
        elif word in ROOT_OPTIONS:
            first += [word, *[value for value in [next(words, None)] if value is not None]]
        elif word.startswith(tuple(f"{option}=" for option in ROOT_OPTIONS)):
            first.append(word)
        else:
            rest.append(word)
    return first + rest


def _end_on_signals() -> None:
    """Make SIGTERM and SIGHUP end the program as Ctrl-C does: child processes are ended, drafts are removed."""

    def end(number: int, _frame: object) -> None:
        sys.exit(128 + number)

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
                signal.signal(getattr(signal, name), end)


def _raise_on_interrupt() -> None:
    """Make Ctrl-C an exception again, which ``vlatool/__main__.py`` ends at once until here; ignored, it stays so."""
    if threading.current_thread() is threading.main_thread() and callable(signal.getsignal(signal.SIGINT)):
        signal.signal(signal.SIGINT, signal.default_int_handler)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit.

    0 ok, 1 gate failed, 2 usage, 3 bad input, 4 missing extra, 5 inconclusive, 70 our bug, 130 interrupted,
    143 ended by SIGTERM. A result that a full disk took makes a 0 a 3.
    With ``--json``, standard output holds one JSON document, of an error too.

    Args:
        arguments: Words of the command line; when None, those of the process, which then ends with this call.
    """
    _open_standard_files()
    _end_on_signals()
    for_good = arguments is None
    words = _with_root_options_first(sys.argv[1:] if arguments is None else arguments)
    if for_good:
        start_early(words)
        _raise_on_interrupt()
    with output(words, for_good=for_good) as document:
        code = _run_command(words, document, for_good=for_good)
    unprinted = take_print_failure()
    forget_kept(printed=unprinted is None)
    if unprinted:
        _say(str(unprinted), unprinted.fix)
        code = code or unprinted.exit_code
    _flush_streams()
    sys.exit(code)


def _run_command(words: list[str], document: Output | None, *, for_good: bool) -> Any:
    """Run a command line; return what the process ends with."""
    try:
        with plain_warnings(), trust.forget_named():
            refuse_two_distributions()
            code = app(words, standalone_mode=False) or 0
        if code == INTERRUPT_CODE:  # typer catches Ctrl-C itself
            raise KeyboardInterrupt
    except SystemExit as left:  # a closed pipe: typer puts a wrapper around stdout and leaves with 1
        code = 0 if type(sys.stdout).__name__ == "PacifyFlushWrapper" else left.code
        if code and document:
            document.fail(failure(left, words))
    except BaseException as error:  # the seam: whatever happened becomes an exit code
        if not isinstance(error, Exception | KeyboardInterrupt):
            raise
        if for_good and isinstance(error, KeyboardInterrupt | typer.Abort):  # once more would interrupt the last words
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        fault = failure(error, words)
        if document and fault.exit_code:
            document.fail(fault)
        _tell(error, fault)
        code = fault.exit_code
    return code


def _tell(error: BaseException, fault: Failure) -> None:
    """Print on stderr what went wrong; raise what may be a bug again where a traceback is asked for."""
    if isinstance(error, CLICK_EXCEPTION):
        with contextlib.suppress(OSError, ValueError):
            error.show()
    elif fault.type in ("InternalError", "PluginError") and os.environ.get("VLATOOL_DEBUG"):
        raise error
    elif fault.exit_code:
        _say(str(fault), fault.fix)


def start_early(words: Sequence[str]) -> None:
    """Start the server of child processes where a command line will need it: it imports while this process does.

    Example:
        >>> start_early(["doctor"])
    """
    if len(words) < 2 or any(word in ("--help", "-h") for word in words):
        return
    if words[0] == "quantize" and words[1] != TRAINING_METHOD:
        children.prepare(GRAPHS_PRELOAD)
    elif words[0] in ("export", "prune", "distill", "verify", "quantize"):
        children.prepare(MODULES_PRELOAD)
