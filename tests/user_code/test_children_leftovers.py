"""What an environment starts ends with the child that runs it, however the command ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from _full import small_or_full

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.jobs import run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.stage.base import Context

WORLD = """\
import os
import time

import numpy as np

HERE = os.path.dirname(__file__)

def once():
    try:
        os.close(os.open(f"{HERE}/began", os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True

def leave_one(how):
    if os.fork():
        return
    if how == "daemon":
        os.setsid()
        if os.fork():
            os._exit(0)
    with open(f"{HERE}/pid.part", "w") as stream:
        stream.write(str(os.getpid()))
    os.rename(f"{HERE}/pid.part", f"{HERE}/pid")
    time.sleep(600)
    os._exit(0)

class World:
    def reset(self, *, seed=None):
        self.steps = 0
        return self.seen(), {}

    def seen(self):
        return {"image": np.zeros((8, 8, 3), np.uint8), "proprio": np.zeros(3), "instruction": "go"}

    def step(self, action):
        if once():
            leave_one(self.how)
        while not os.path.exists(f"{HERE}/pid"):
            time.sleep(0.01)
        if os.path.exists(f"{HERE}/slow"):
            time.sleep(600)
        return self.seen(), 0.0, True, False, {"success": True}

def make(task):
    world = World()
    world.how = task
    return world
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """The folder of a world that forks a process once, which sleeps for ten minutes and is noted in ``pid``."""
    (tmp_path / "world.py").write_text(WORLD)
    yield tmp_path
    if (tmp_path / "pid").exists() and lives(pid := int((tmp_path / "pid").read_text())):
        os.kill(pid, signal.SIGKILL)


def lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def comes(what: Callable[[], bool]) -> bool:
    """Wait until something is so; say whether it was within a minute."""
    end = time.monotonic() + 60
    while not what() and time.monotonic() < end:
        time.sleep(0.02)
    return what()


@pytest.mark.parametrize("how", ["fork", "daemon"])
def test_the_run_goes_on_and_what_was_forked_ends_with_it(folder: Path, float_bundle: Bundle, how: str):
    outcomes = run_jobs(float_bundle, [EpisodesJob("world.py:make", str(folder), how, (7, 8))], "", Context())
    assert [outcome.success for outcome in outcomes] == [True, True]
    pid = int((folder / "pid").read_text())
    assert comes(lambda: not lives(pid))


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, signal.SIGKILL, *small_or_full([], [signal.SIGINT])], ids=lambda number: number.name
)
def test_nothing_is_left_of_a_command_that_is_ended(folder: Path, float_bundle: Bundle, number: signal.Signals):
    (folder / "slow").touch()
    words = ["evaluate", "closed-loop", str(float_bundle.path), "--environment", f"{folder}/world.py:make",
             "--tasks", "fork", "--episodes", "2", "--workers", "1"]  # fmt: skip
    command = subprocess.Popen(
        [sys.executable, "-m", "vlatool", *words], env={**os.environ, "VLATOOL_CACHE": str(folder / "cache")},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert comes((folder / "pid").exists)
    command.send_signal(number)
    _, errors = command.communicate(timeout=60)
    assert command.returncode in (130, 128 + number, -number), errors
    pid = int((folder / "pid").read_text())
    assert comes(lambda: not lives(pid))
