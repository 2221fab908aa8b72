from __future__ import annotations

import subprocess
import sys

import pytest

from vlatool.errors import SourceError
from vlatool.user_code import children

ENDING = """
import os, signal
from vlatool.user_code import children

signal.signal(signal.SIGINT, signal.default_int_handler)
server = children._Server(dict(os.environ))
children._servers[(str(os.getpid()),)] = server
wait = server.process.wait

def interrupted(patience=None):
    os.kill(os.getpid(), signal.SIGINT)
    return wait(patience)

server.process.wait = interrupted
"""


REPORTED = """
stop = server.stop
server.stop = lambda: (stop(), print(server.process.returncode))
"""


def test_ctrl_c_while_the_children_end_is_no_traceback() -> None:
    done = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_while_the_children_end_ends_them_at_once_without_a_traceback(name: str) -> None:
    code = ENDING.replace("import os, signal", "import os, signal\nfrom vlatool.cli import _end_on_signals")
    code = code.replace("signal.signal(signal.SIGINT, signal.default_int_handler)", "_end_on_signals()")
    code = code.replace(
        "os.kill(os.getpid(), signal.SIGINT)",
        f"os.kill(server.process.pid, signal.SIGSTOP)\n    os.kill(os.getpid(), signal.{name})",
    )
    done = subprocess.run([sys.executable, "-c", code + REPORTED], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "-9\n")


def test_what_vlatools_own_code_raises_is_named_and_not_blamed_on_the_policy() -> None:
    """It stays an error with exit code 3: what a child says decides no exit code."""
    says = r"^vlatool\.stage\._child\._stage_of failed in the process that runs policy\.py: KeyError: 'stage'\.\n"
    with pytest.raises(SourceError, match=says) as caught:
        children.call("vlatool.stage._child:run", {}, lambda *_: None, "policy.py")
    assert caught.value.fix.startswith("that is vlatool's own code: report it")
