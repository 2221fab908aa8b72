"""What processes that vlatool starts have in common: isolated, they find this vlatool, in as many threads as meant."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

SINGLE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Variables that make numpy's libraries compute in one thread; read when they are loaded."""
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Of ``prctl(2)``."""
START = """\
import sys
sys.path[:] = sys.argv.pop(1).splitlines()
import runpy
sys.argv[:] = sys.argv[1:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""What an isolated process does first: ``-P`` would say it shorter, from Python 3.11 on."""

NO_MEMORY = (
    "MemoryError", "bad_alloc", "bad allocation", "ailed to allocate", "ut of memory", "annot allocate",
    "Memory allocation", "failed to map segment", "cannot change memory protections", "static TLS block",
)  # fmt: skip
"""What Python, C++, the dynamic linker and engines say when a limit on memory is reached; a control group kills."""


def signal_name(code: int) -> str:
    """Return the name of the signal that ended a process, from its negative exit code."""
    try:
        return signal.Signals(-code).name
    except ValueError:  # a real-time signal has no name
        return f"signal {-code}"


def python_command(module: str, arguments: Sequence[str] = (), path: Sequence[str] | None = None) -> list[str]:
    """Return the command that runs a module as ``__main__`` in an isolated Python (``-I``).

    Neither the current directory nor variables of Python choose what it imports, but ``import_path()`` alone.

    Args:
        arguments: ``sys.argv[1:]`` of the module.
        path: where modules are imported from; ``import_path()`` when None.
    """
    joined = "\n".join(import_path() if path is None else path)
    return [sys.executable, "-I", "-c", START, joined, module, *arguments]


def python_code(code: str, arguments: Sequence[str] = ()) -> list[str]:
    """Return the command that runs some code in an isolated Python; see ``python_command``."""
    begin = "import sys\nsys.path[:] = sys.argv.pop(1).splitlines()\n"
    return [sys.executable, "-I", "-c", begin + code, "\n".join(import_path()), *arguments]


def import_path() -> list[str]:
    """Return where a child imports from: as this process, less the current directory that Python itself put first.

    The current directory stays where the user's own ``PYTHONPATH`` names it. This vlatool comes before what is
    installed, and after the standard library.
    """
    own = {os.path.realpath(entry) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry}
    here = os.path.realpath(os.curdir)
    absolute = [os.path.abspath(entry) for entry in sys.path if entry]
    entries = [entry for entry in dict.fromkeys(absolute) if os.path.realpath(entry) != here or here in own]
    package = str(Path(__file__).resolve().parents[2])
    if package in entries:
        return entries
    installed = (at for at, entry in enumerate(entries) if Path(entry).name in ("site-packages", "dist-packages"))
    entries.insert(next(installed, len(entries)), package)
    return entries


def die_with_parent() -> None:
    """Let the kernel kill this process when the thread that started it ends, however that ends (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def adopt_orphans() -> None:
    """Become the parent of whatever processes that descend from this one leave behind when they end (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)


@contextlib.contextmanager
def single_threads() -> Iterator[None]:
    """Let processes that are started meanwhile compute in one thread: they are as many as there are processors."""
    before = {name: os.environ.get(name) for name in SINGLE}
    os.environ.update(SINGLE)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
