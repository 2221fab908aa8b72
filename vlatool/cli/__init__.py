"""The command line: parse, call, render; no logic."""

from __future__ import annotations

import os
import signal
import sys
import threading
from typing import Annotated, Any

import typer

from vlatool import __version__
from vlatool.cli._console import plain_warnings
from vlatool.cli._stages import StageGroup
from vlatool.cli.compare import compare
from vlatool.cli.doctor import doctor
from vlatool.cli.explain import explain
from vlatool.cli.gate import app as gate
from vlatool.cli.hwselect import app as hwselect
from vlatool.cli.inspect import inspect
from vlatool.cli.optimize import optimize
from vlatool.cli.profiles import app as profiles
from vlatool.cli.rebuild import rebuild
from vlatool.cli.samples import app as samples
from vlatool.cli.simulate import simulate
from vlatool.cli.telemetry import telemetry
from vlatool.errors import VlatoolError
from vlatool.printable import printable

INTERRUPTED = 130
OUR_BUG = 70
CLICK_EXCEPTION: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")
"""The base of usage errors: of the click that typer brings, or of the one that it imports, by its version."""

app = typer.Typer(
    name="vlatool",
    help="Make a trained robot policy run, fast and safely, on the board that the robot carries.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"vlatool {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Make a trained robot policy run, fast and safely, on the board that the robot carries."""


app.command("optimize")(optimize)
for _kind, _text in (
    ("export", "Turn a policy into a bundle with graphs that ONNX Runtime was seen to run."),
    ("quantize", "Make a bundle of lower precision."),
    ("benchmark", "Measure latency and memory through the runtime."),
    ("evaluate", "Measure accuracy, on recordings or in the closed loop."),
):
    app.add_typer(typer.Typer(cls=StageGroup, help=_text, rich_markup_mode=None), name=_kind)
app.command("compare")(compare)
app.command("inspect")(inspect)
app.command("explain")(explain)
app.command("rebuild")(rebuild)
app.command("doctor")(doctor)
app.command("simulate")(simulate)
app.command("telemetry")(telemetry)
app.add_typer(gate, name="gate")
app.add_typer(hwselect, name="hwselect")
app.add_typer(profiles, name="profiles")
app.add_typer(samples, name="samples")

KEEPING = frozenset(("optimize", "export", "quantize"))
"""Commands whose finished stages stay in the cache when they are interrupted."""


def _end_on_signals() -> None:
    """Let SIGTERM and SIGHUP end the program as Ctrl-C does: what it started is ended, what it began is removed."""

    def end(number: int, _frame: object) -> None:
        sys.exit(128 + number)

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
                signal.signal(getattr(signal, name), end)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit.

    0 ok, 1 gate failed, 2 usage, 3 bad input, 4 missing extra, 5 inconclusive, 70 our bug, 130 interrupted.
    """
    _end_on_signals()
    try:
        with plain_warnings():
            code = app(arguments, standalone_mode=False) or 0
        if code == INTERRUPTED:  # typer catches Ctrl-C itself
            raise KeyboardInterrupt
        sys.exit(code)
    except SystemExit as left:  # a closed pipe: typer puts a wrapper around stdout and leaves with 1
        sys.exit(0 if type(sys.stdout).__name__ == "PacifyFlushWrapper" else left.code)
    except CLICK_EXCEPTION as error:
        error.show()
        sys.exit(error.exit_code)
    except VlatoolError as error:
        typer.echo(f"error: {printable(error.message)}", err=True)
        if error.fix:
            typer.echo(f"  fix: {printable(error.fix)}", err=True)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        kept = "; finished stages are kept" if KEEPING.intersection((arguments or sys.argv[1:])[:1]) else ""
        typer.echo(f"interrupted{kept}", err=True)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        typer.echo(f"error: {error.filename or 'a file'}: {error.strerror or error}.", err=True)
        sys.exit(3)
    except MemoryError:
        typer.echo("error: out of memory.\n  fix: use a machine with more memory, or a smaller policy", err=True)
        sys.exit(3)
    except Exception as error:
        if os.environ.get("VLATOOL_DEBUG"):
            raise
        typer.echo(f"internal error: {type(error).__name__}: {error}", err=True)
        typer.echo("  fix: this is a bug in vlatool; run again with VLATOOL_DEBUG=1 and report the traceback", err=True)
        sys.exit(OUR_BUG)
