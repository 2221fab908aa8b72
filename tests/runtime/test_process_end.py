"""A process ends with the exit code of its program, also while a thread is in an engine that nothing stops."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from _written import written
from test_first_run_limits import ONE_NODE

HALF_A_SECOND = ONE_NODE.replace("2047, 2047", "13, 13")
"""One node that takes a part of a second, and cannot be stopped either."""
CHILD = """
import ctypes, os, sys, time
from pathlib import Path
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DeadlineMissed
from vlatool.runtime import Policy, process_end
from vlatool.runtime.control import build_controller
from vlatool.runtime.control.deadline import Deadline

process_end.EXIT_S = 0.01
policy, seen = Policy.open(Bundle.open(Path(sys.argv[1])), threads=1), {"x": [1, 2]}

class Last:
    "Destroyed while Python shuts down, which it delays until no thread computes any more."

    def __del__(self, os=os, open=open, sleep=time.sleep):
        before, used = None, []
        for _ in range(60):
            files = [f"/proc/self/task/{task}/stat" for task in os.listdir("/proc/self/task")]
            used = [open(file).read().split()[13] for file in files]
            if used == before:
                break
            before = used
            sleep(0.25)


def miss():
    try:
        Deadline(policy, 50).infer(seen)
    except DeadlineMissed:
        print("missed", flush=True)


def hold():
    ctypes.CDLL(None).printf(b"held by the C library")
"""
AT_THE_END = {"exit": "sys.exit(7)", "raise": "raise KeyError('it failed')", "return": ""}
CODES = {"exit": 7, "raise": 1, "return": 0}


def started(code: str, bundle: Path) -> subprocess.Popen[str]:
    line = [sys.executable, "-c", CHILD + code, str(bundle)]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_node_that_returns_while_python_shuts_down_does_not_end_the_process(tmp_path: Path):
    """Without ``leave_busy_threads`` each of them ends with SIGABRT."""
    bundle = written(tmp_path, HALF_A_SECOND).path
    children = {end: started(f"miss()\nhold()\nlast = Last()\n{line}", bundle) for end, line in AT_THE_END.items()}
    for end, child in children.items():
        output, errors = child.communicate(timeout=100)
        assert "terminate" not in errors
        assert (child.returncode, output) == (CODES[end], "missed\nheld by the C library")
        assert ("KeyError" in errors) == (end == "raise")


@pytest.mark.parametrize(
    "code",
    [
        "miss()\nhold()",
        "asked = build_controller(policy, ['asynchronous:background=true'])\n"
        "asked._inference.start(seen)\nprint('missed', flush=True)\ntime.sleep(0.2)\nhold()",
    ],
    ids=["deadline", "background"],
)
def test_a_node_that_takes_hours_does_not_keep_the_process_from_ending(tmp_path: Path, code: str):
    child = started(f"{code}\nsys.exit(7)", written(tmp_path, ONE_NODE).path)
    output, errors = child.communicate(timeout=100)
    assert (child.returncode, output, errors) == (7, "missed\nheld by the C library", "")


def test_without_a_busy_thread_nothing_is_left_out():
    code = """
import time
from vlatool.runtime import process_end
from vlatool.runtime.worker import Worker

class Nothing:
    begin = run = stop = undo = lambda self: None

worker = Worker()
worker.call(Nothing(), time.monotonic() + 20)
process_end.leave_busy_threads = lambda: print("left")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")
