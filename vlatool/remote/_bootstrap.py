"""What runs on the target: it receives files, runs the agent, tells what it says, and removes all of it.

``vlatool.remote.ssh`` sends the text of this file to a Python (3.10 or later, standard library only) on the other end
of an ssh connection. Standard input brings the files, the job and then a sign of life every few seconds; when it ends
or falls silent, so does the run. Each message on standard output is a line of JSON after a marker, since what the
start-up files of a shell print comes the same way. A guard, a second process, cleans up when this one is killed.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path, PurePosixPath
from typing import IO, Any, NoReturn, cast

from vlatool.remote._run_directory import BLOCK, Guard, Refused, RunDirectory, kill

QUIET_S = 60
"""Seconds without a sign of life, or without anybody who takes what is said, after which the run ends."""
SLACK = 8 << 20
"""Bytes beside the files that must be free."""
LOG = 1 << 16
"""Bytes of the agent's standard error that are kept, the last ones."""
LONGEST = 1 << 26


class Stop(BaseException):
    """The run ends: a signal, or nobody listens any more."""


class Line:
    """The connection: standard input and output as messages."""

    def __init__(self, marker: str) -> None:
        self._marker = marker
        self._pending = b""

    def say(self, **message: Any) -> None:
        """Write one message; ends the run when nobody takes it."""
        rest = memoryview(f"\n{self._marker}{json.dumps(message)}\n".encode())
        signal.alarm(QUIET_S)
        try:
            while rest:
                rest = rest[os.write(1, rest) :]
        except OSError as error:
            raise Stop from error
        finally:
            signal.alarm(0)

    def take(self, count: int) -> bytes:
        """Return exactly so many bytes."""
        while len(self._pending) < count:
            self._more(count - len(self._pending))
        taken, self._pending = self._pending[:count], self._pending[count:]
        return taken

    def message(self) -> dict[str, Any]:
        """Return the next line of JSON; empty lines are signs of life."""
        while True:
            while b"\n" not in self._pending:
                if len(self._pending) > LONGEST:
                    raise Refused("corrupt", "a line without an end")
                self._more(BLOCK)
            line, _, self._pending = self._pending.partition(b"\n")
            if line.strip():
                try:
                    message: dict[str, Any] = json.loads(line)
                except ValueError as error:
                    raise Refused("corrupt", "a line that is not a message") from error
                return message

    def listen(self) -> None:
        """Take signs of life; ends the run when the other side is gone."""
        self._more(BLOCK)
        self._pending = b""

    def _more(self, count: int) -> None:
        if not select.select([0], [], [], QUIET_S)[0]:
            raise Stop
        received = os.read(0, min(max(count, BLOCK), 1 << 20))
        if not received:
            raise Stop
        self._pending += received


def unpack(packed: bytes, root: Path) -> None:
    """Append each file of a tar to the file of that name below ``root``: a large file comes in pieces."""
    with tarfile.open(fileobj=io.BytesIO(packed), mode="r:") as pack:
        for member in pack:
            path = PurePosixPath(member.name)
            if not member.isreg() or path.is_absolute() or ".." in path.parts or not path.parts:
                raise Refused("corrupt", f"{member.name!r} is not a file below the directory")
            content = pack.extractfile(member)
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            with (root / path).open("ab") as stream:
                shutil.copyfileobj(content or io.BytesIO(), stream)


def receive(line: Line, directory: RunDirectory) -> dict[str, Any]:
    """Receive files until the job comes, and return it."""
    while True:
        message = line.message()
        if "job" in message:
            return message
        packed = line.take(int(message["bytes"]))
        if hashlib.sha256(packed).hexdigest() != message["sha256"]:
            raise Refused("corrupt", "the SHA-256 of a piece differs")
        unpack(packed, directory.path)


def run(line: Line, directory: RunDirectory, guard: Guard, message: dict[str, Any]) -> dict[str, Any]:
    """Run the agent and tell its lines; return how it ended and the last that it logged."""
    package = directory.path / "package"
    job = {**message["job"], "bundles": [str(directory.path / name) for name in message["bundles"]]}
    (directory.path / "job.json").write_text(json.dumps(job) + "\n", encoding="utf-8")
    folders = {"TMPDIR": directory.path / "tmp", "XDG_CACHE_HOME": directory.path / "cache"}
    for folder in folders.values():
        folder.mkdir()
    paths = os.pathsep.join(filter(None, [str(package), os.environ.get("PYTHONPATH")]))
    cache = str(directory.path / "cache")
    own = {"PYTHONPATH": paths, "PYTHONUTF8": "1", "PYTHONUNBUFFERED": "1", "VLATOOL_CACHE": cache}
    environment = {**os.environ, **{name: str(folder) for name, folder in folders.items()}, **own}
    environment.pop("PYTHONPYCACHEPREFIX", None)
    command = [sys.executable, "-m", message["module"]]
    with (directory.path / "job.json").open("rb") as stdin:
        agent = subprocess.Popen(
            command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=package, env=environment,
            start_new_session=True, bufsize=0,
        )  # fmt: skip
    try:
        guard.watch(agent.pid)
        log = _follow(line, agent)
        return {"code": agent.wait(), "log": log.decode("utf-8", "replace")}
    finally:
        kill(agent.pid)
        agent.wait()


def _follow(line: Line, agent: subprocess.Popen[bytes]) -> bytes:
    """Tell what the agent says until it has ended, and return the end of what it logged."""
    output, logged = cast(IO[bytes], agent.stdout).fileno(), cast(IO[bytes], agent.stderr).fileno()
    streams, rest, log = [output, logged], b"", b""
    last_sign, ended = time.monotonic(), 0.0
    while streams or agent.poll() is None:
        ready = select.select([0, *streams], [], [], 1 if streams else 0.02)[0]
        now = time.monotonic()
        if 0 in ready:
            line.listen()
            last_sign = now
        if now - last_sign > QUIET_S:
            raise Stop
        for handle in set(ready) & set(streams):
            received = os.read(handle, 1 << 16)
            streams = [other for other in streams if received or other != handle]
            if handle == logged:
                log = (log + received)[-LOG:]
                continue
            *lines, rest = (rest + received).split(b"\n") if b"\n" in received or not received else (rest + received,)
            for text in [*lines, *([rest] if not received else [])]:
                if text.lstrip().startswith(b"{"):
                    line.say(agent=text.decode("utf-8", "replace"))
                else:
                    log = (log + text + b"\n" * bool(text))[-LOG:]
        if agent.poll() is not None:
            kill(agent.pid)
            ended = ended or now
            if now - ended > 5:  # held open by a process that left the group
                break
    return log


def _stop(_number: int, _frame: Any) -> NoReturn:
    raise Stop


def serve(line: Line) -> None:
    """Receive, run and clean up; whatever happens, what was made is removed before the last message."""
    directory = RunDirectory()
    guard: Guard | None = None
    last: dict[str, Any] = {}
    try:
        need = int(line.message()["need"]) + SLACK
        directory.make()
        guard = Guard(directory)
        if (free := directory.room()) < need:
            raise Refused("no room", json.dumps({"free": free, "need": need, "path": str(directory.path)}))
        line.say(ready=str(directory.path))
        message = receive(line, directory)
        line.say(received=True)
        last = {"ended": run(line, directory, guard, message)}
    except Refused as error:
        last = {"refused": error.word, "text": error.text}
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        last = {
            "refused": "full" if full else "system",
            "text": f"{error.filename or ''}: {error.strerror}".lstrip(": "),
        }
    except tarfile.TarError as error:
        last = {"refused": "corrupt", "text": str(error)}
    finally:
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        left = directory.remove()
        if guard:
            guard.dismiss()
    line.say(**last, left=left)


def main(marker: str) -> None:
    """Serve one run; silent when the other side is gone."""
    os.umask(0o077)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT, signal.SIGALRM):
        signal.signal(number, _stop)
    with contextlib.suppress(Stop):
        serve(Line(marker))


if __name__ == "__main__":
    main(sys.argv[1])
