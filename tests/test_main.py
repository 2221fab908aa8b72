"""The first second of a command: modules are imported, and Ctrl-C may come in the middle of it."""

import subprocess
import sys

import pytest

INTERRUPTS = """
import builtins, os, signal, sys
sys.argv = ["vlatool", "--version"]
real, wanted = builtins.__import__, {wanted!r}
def interrupted(name, *more):
    if name.startswith(wanted):
        os.kill(os.getpid(), signal.SIGINT)
    return real(name, *more)
builtins.__import__ = interrupted
{first}
from vlatool.__main__ import main
main()
"""


@pytest.mark.parametrize("wanted", ["vlatool.errors", "vlatool.cli", "typer", "vlatool.user_code"])
def test_ctrl_c_while_modules_are_imported_ends_as_anywhere_else(wanted: str) -> None:
    code = INTERRUPTS.format(wanted=wanted, first="")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_ctrl_c_that_is_ignored_stays_so() -> None:
    code = INTERRUPTS.format(wanted="vlatool.cli", first="signal.signal(signal.SIGINT, signal.SIG_IGN)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("vlatool ")
