"""Programs of ROS 1 and of vlatool in processes of their own, for ``ros1_live.py`` and ``ros1_launch.py``."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from _ros1 import Master, hear_interrupts

END_S = 20.0


class Programs:
    """Starts programs beside a master, and ends them all; a context.

    Args:
        folder: Where ROS 1 is.
        environment: Environment in which it runs.
        logs: Folder for what each program prints.
    """

    def __init__(self, folder: Path, environment: dict[str, str], logs: Path) -> None:
        self.folder, self.logs = folder, logs
        logs.mkdir(parents=True, exist_ok=True)
        self.master = Master(folder, environment)
        self.environment = {
            **environment, "ROS_MASTER_URI": self.master.uri, "ROS_IP": "127.0.0.1", "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }  # fmt: skip
        self._running: list[Program] = []

    def vlatool(self, *words: object) -> Program:
        """Start ``vlatool WORDS``."""
        return self._start(f"vlatool-{words[0]}-{words[1]}", [sys.executable, "-m", "vlatool", *words])

    def ros(self, name: str, *words: object) -> Program:
        """Start a program of ROS 1 in Python, such as ``rosbag``."""
        return self._start(f"{name}-{words[0]}", [sys.executable, self.folder / "root/usr/bin" / name, *words])

    def python(self, code: str, *words: object) -> Program:
        """Start a program of a user: Python code with words behind it."""
        return self._start("python", [sys.executable, "-c", code, *words])

    def _start(self, name: str, command: Sequence[object]) -> Program:
        path = self.logs / f"{len(self._running)}-{Path(name).name}.log"
        self._running.append(Program([*map(str, command)], self.environment, path))
        return self._running[-1]

    def __enter__(self) -> Programs:
        return self

    def __exit__(self, *_: object) -> None:
        for each in reversed(self._running):
            each.kill()
        self.master.kill()


class Program:
    """A program in a session of its own, whose words go to a file."""

    def __init__(self, command: list[str], environment: dict[str, str], path: Path) -> None:
        self.path, self._file = path, path.open("wb")
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=self._file, text=True, start_new_session=True,
            preexec_fn=hear_interrupts,
        )  # fmt: skip

    def errors(self) -> str:
        """Return what it has written to standard error so far."""
        return self.path.read_text(errors="replace")

    def wait_for(self, word: str, timeout_s: float = END_S) -> None:
        """Wait until it has written a word to standard error."""
        await_true(
            lambda: word in self.errors() or self.process.poll() is not None, timeout_s, f"{word} in {self.path}"
        )

    def end(self, number: int = signal.SIGINT, timeout_s: float = END_S) -> int:
        """Send a signal, to rosbag's program below, too; return the exit code."""
        if self.process.poll() is None:
            signal_group(self.process.pid, number)
        return self.process.wait(timeout_s)

    def answer(self, timeout_s: float = 60.0) -> tuple[int, str]:
        """Wait until it ends; return its exit code and what it wrote to standard output."""
        text, _ = self.process.communicate(timeout=timeout_s)
        return self.process.returncode, text

    def kill(self) -> None:
        """End it and its children as a crash does."""
        if self.process.poll() is None:
            signal_group(self.process.pid, signal.SIGKILL)
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._file.close()


def signal_group(process: int, number: int) -> None:
    """Send a signal to a process and its children, which share a session."""
    try:
        os.killpg(process, number)
    except ProcessLookupError:
        return


def await_true(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Wait for a condition."""
    until = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > until:
            raise SystemExit(f"waited {timeout_s:g} s in vain for {what}")
        time.sleep(0.05)


def read_json(text: str) -> dict[str, Any]:
    """Return the document that vlatool printed, empty when it printed none."""
    document: dict[str, Any] = json.loads(text) if text.strip().startswith("{") else {}
    return document
