"""Call functions of vlatool that run a user's code, in child processes that this process survives.

A policy or an environment may leave (``sys.exit``), crash, print, change the directory, signal handlers and variables:
it does so in a child, which a server forks that has imported the libraries once. What is printed is shown on standard
error; an answer that does not come is an error that says how the child ended.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any

from vlatool.errors import SourceError
from vlatool.files.printable import truncate
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.machine.processes import SINGLE, import_path, python_command
from vlatool.machine.watched_calls import Page, new_page
from vlatool.user_code import trust
from vlatool.user_code._answers import ChildKilled as ChildKilled
from vlatool.user_code._answers import ChildState, ending_error, plain, read
from vlatool.user_code._answers import error_record as error_record
from vlatool.user_code._answers import exit_error as exit_error
from vlatool.user_code._answers import result as result
from vlatool.user_code._child_output import BLOCK_BYTES, ChildOutput

OnProgress = Callable[[str, float | None], None]
MAX_ANSWER_BYTES = 1 << 28
"""Bytes of one line of an answer."""
STOP_TIMEOUT_S = 5.0
POLL_S, REPORT_AFTER_S = 0.2, 10.0
"""How often a call that may never return is looked at, and from when on it is said; earlier where it may take less."""


class _Server:
    """The process that forks the children."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.used = False
        self.control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            quiet = subprocess.DEVNULL
            self.process = subprocess.Popen(
                python_command("vlatool.user_code._child", (str(theirs.fileno()),)),
                stdin=quiet, stdout=quiet, stderr=quiet, pass_fds=[theirs.fileno()], env=dict(environment),
            )  # fmt: skip

    def fork(self, preload: Sequence[str], fds: list[int]) -> None:
        """Fork a child that gets these descriptors; import alone when there are none."""
        self.used = self.used or bool(fds)
        socket.send_fds(self.control, [json.dumps(list(preload)).encode()], fds)

    def stop(self) -> None:
        """End the server and with it all children."""
        self.control.close()
        if not self.used:  # it may be in the middle of importing
            self.process.kill()
        try:
            self.process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


_servers: dict[tuple[str, ...], _Server] = {}
_lock = threading.Lock()


def _fork(preload: Sequence[str], fds: list[int], environment: Mapping[str, str]) -> None:
    """Fork a child; start a server when there is none, when it has died, or when its libraries were loaded otherwise.

    Some variables are read when a library is loaded, as the number of threads and the instruction set are.
    """
    kind = (str(os.getpid()), *(environment.get(name, "") for name in (*SINGLE, MAX_CPU_ISA)))
    with _lock:
        if kind in _servers:
            with contextlib.suppress(OSError):
                _servers[kind].fork(preload, fds)
                return
            _servers.pop(kind).stop()
        _servers[kind] = _Server(environment)
        _servers[kind].fork(preload, fds)


def prepare(preload: Sequence[str]) -> None:
    """Let the server start and import what a child will need, while this process does something else."""
    with contextlib.suppress(OSError):
        _fork(preload, [], os.environ)


@atexit.register
def _stop() -> None:
    own = [server for kind, server in _servers.items() if kind[0] == str(os.getpid())]

    def hasten(_number: int, _frame: object) -> None:
        for server in own:
            server.process.kill()

    with contextlib.suppress(ValueError):  # the process ends already, and what it was asked for is done
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for name in ("SIGTERM", "SIGHUP") if own else ():
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), hasten)
    for server in own:
        server.stop()


class Child:
    """A child process that answers calls one after the other; what a call leaves in it, the next one finds.

    Args:
        about: name of the code that it runs, for messages: ``policy.py``.
        preload: modules that the server imports before it forks.
        environment: variables that it has beside those of this process.
    """

    def __init__(self, about: str, preload: Sequence[str] = (), environment: Mapping[str, str] | None = None) -> None:
        self.about = about
        self._talk, talk = socket.socketpair()
        self._status, status = socket.socketpair()
        self._output, output = os.pipe()
        page = new_page()
        self._page = Page(page)
        self._open: list[Any] = [self._talk, self._output, self._status]
        self._last = ChildState()
        self._said = ChildOutput(about, self._last)
        self._received = b""
        self._said_s = 0
        variables = {**os.environ, **(environment or {})}
        try:
            _fork(preload, [talk.fileno(), output, status.fileno(), page], variables)
        finally:
            talk.close()
            status.close()
            os.close(output)
            os.close(page)
        hello = {
            "folder": os.getcwd(), "environment": variables, "path": import_path(),
            "processors": sorted(os.sched_getaffinity(0)), "named": trust.named_folders(),
        }  # fmt: skip
        self._send(hello)

    def __enter__(self) -> Child:
        return self

    def __exit__(self, kind: object, *_exception: object) -> None:
        if kind is None:  # it has nothing left to do, and ends by itself
            self._talk.shutdown(socket.SHUT_WR)
            select.select([self._status], [], [], STOP_TIMEOUT_S)
            self._print(last=True)
        self.end()
        for stream in (self._talk, self._status):
            stream.close()
        os.close(self._output)
        self._page.close()

    def end(self) -> None:
        """End the child, from any thread; a call that waits for it ends too."""
        for stream in (self._talk, self._status):
            with contextlib.suppress(OSError):
                stream.shutdown(socket.SHUT_RDWR)

    def call(self, function: str, job: Mapping[str, Any], tell: OnProgress, *, own: bool = False) -> Any:
        """Call ``module:function`` of vlatool with a job and ``tell``; return its result. All are JSON values.

        Args:
            function: what is called, with ``job`` and ``tell``.
            own: whether it runs vlatool's code alone, and a policy's in its own children.

        Raises:
            VlatoolError: what it raises, of the same class; SourceError when the child ends without an answer.
            RuntimeError: where ``own``, for a bug of vlatool.
            OSError, MemoryError: what it meets.
            KeyboardInterrupt: when Ctrl-C ended the child.
        """
        self._last.own, self._last.doing, self._last.told = own, None, ""
        self._send({"call": function, "job": dict(job)})
        while True:
            for line in self._read_replies(tell):
                if "progress" in line:
                    self._last.told = plain(line["progress"][0])
                    tell(self._last.told, line["progress"][1])
                elif "doing" in line:
                    what = line["doing"]
                    self._last.doing = what and (plain(what[0]), plain(what[1]), plain(what[2]))
                elif "warning" in line:
                    warnings.warn(truncate(line["warning"]), UserWarning, stacklevel=2)
                else:
                    self._print()
                    return result(line, self.about, own=own)

    def _send(self, line: Mapping[str, Any]) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # how it ended is found by reading
            self._talk.sendall(json.dumps(line).encode() + b"\n")

    def _read_replies(self, tell: OnProgress) -> Iterable[dict[str, Any]]:
        """Wait for the child; return what it says, and show what it prints.

        What it calls that may never return is looked at from here: a library may let no thread of its process run.

        Lines are read one by one: what was said before a line that is nonsense counts, though both came together.
        """
        waits = self._talk in self._open
        ready = select.select(self._open, [], [], POLL_S if waits else STOP_TIMEOUT_S)[0]
        if waits and not {self._talk, self._status}.intersection(ready):
            self._check_call(tell)
            if not ready:
                return []
        if self._output in ready:
            self._print()
        if self._talk in ready:
            self._receive()
        *whole, self._received = self._received.split(b"\n")
        if whole:
            return (read(line, self.about) for line in whole)
        if self._status in ready and not (self._talk in self._open and self._receive()):
            self._print(last=True)
            raise ending_error(_receive_all(self._status), self.about, self._last)
        if not ready:
            raise SourceError(f"{self.about} closed what its process answers with.", "let it close its own files alone")
        return []

    def _check_call(self, tell: OnProgress) -> None:
        """Say what the child waits for, and end it where a call takes longer than it may."""
        call = self._page.read()
        waited = 0.0 if call is None else time.monotonic() - call.begun
        if call is not None and waited > call.limit_s:
            self.end()
            at = f" {plain(call.at)}" if call.at else ""
            raise SourceError(f"{plain(call.whose)} did not return within {call.limit_s:g} s{at}.", plain(call.fix))
        if call is not None and waited >= min(REPORT_AFTER_S, call.limit_s / 10) and int(waited) > self._said_s:
            tell(f"waiting for {plain(call.waiting)}, {int(waited)} s of {call.limit_s:g} s", None)
        self._said_s = int(waited)

    def _receive(self) -> bool:
        """Read what the child says; say whether there was anything."""
        try:
            more = self._talk.recv(BLOCK_BYTES, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except ConnectionResetError:
            more = b""
        if not more:
            self._open.remove(self._talk)
        self._received += more
        if len(self._received) > MAX_ANSWER_BYTES:
            raise SourceError(
                f"{self.about}: the process that runs it answers more than {MAX_ANSWER_BYTES:,} bytes.",
                "let it answer less: fewer episodes or samples at a time, and its own files alone",
            )
        return bool(more)

    def _print(self, last: bool = False) -> None:
        """Show what the child has printed."""
        while self._output in self._open and select.select([self._output], [], [], 0)[0]:
            printed = os.read(self._output, BLOCK_BYTES)
            if not printed:
                self._open.remove(self._output)
            self._said.take(printed)
        if last:
            self._said.take(b"\n")


def call(
    function: str,
    job: Mapping[str, Any],
    tell: OnProgress,
    about: str,
    preload: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    *,
    own: bool = False,
) -> Any:
    """Call a function in a child of its own; see ``Child`` and ``Child.call``."""
    with Child(about, preload, environment) as child:
        return child.call(function, job, tell, own=own)


def map_jobs(
    function: str,
    jobs: Sequence[Mapping[str, Any]],
    processes: int,
    tell: OnProgress,
    about: str,
    preload: Sequence[str] = (),
    last: str = "",
    done: Callable[[int, Any], None] | None = None,
) -> Generator[Any, None, None]:
    """Yield the result of every job, in order, computed in several children; close the iterator to end them.

    Args:
        last: called in every child when all is done, with an empty job.
        done: function called with the number of a job and its result as soon as it is there, in a thread of its own.
    """  # fmt: skip
    idle: SimpleQueue[Child] = SimpleQueue()

    def run(number: int, job: Mapping[str, Any]) -> Any:
        child = idle.get()
        try:
            answer = child.call(function, job, tell)
        finally:
            idle.put(child)
        if done is not None:
            done(number, answer)
        return answer

    with contextlib.ExitStack() as opened, ThreadPoolExecutor(processes) as threads:
        children = [opened.enter_context(Child(about, preload)) for _ in range(max(1, min(processes, len(jobs))))]
        for child in children:
            idle.put(child)
        try:
            yield from threads.map(run, range(len(jobs)), jobs)
            for child in children if last else ():
                child.call(last, {}, tell)
        except BaseException:  # Ctrl-C too: what runs ends
            threads.shutdown(wait=False, cancel_futures=True)
            for child in children:
                child.end()
            raise


def _receive_all(stream: socket.socket) -> bytes:
    """Return what there is to read, nothing at the end."""
    try:
        return stream.recv(BLOCK_BYTES, socket.MSG_DONTWAIT)
    except (BlockingIOError, ConnectionResetError):
        return b""
