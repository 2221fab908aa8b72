"""The other side of ``children``: ``python -m vlatool.user_code._child FD`` is the server that forks the children.

The server imports what its children need once, and never runs a user's code itself. It ends with its parent, each of
its children with it, and with each child whatever that has started: the server adopts what is left, and kills it.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any

import psutil

from vlatool.files.limits import limit
from vlatool.files.printable import message_of
from vlatool.machine import engine_calls
from vlatool.machine.processes import adopt_orphans, die_with_parent
from vlatool.machine.watched_calls import note_calls_on
from vlatool.user_code import trust
from vlatool.user_code._answers import error_record

MAX_DESCRIPTORS = 4
MAX_MESSAGE_BYTES = 1 << 16
END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main() -> None:
    """Serve until the parent is gone."""
    control = socket.socket(fileno=int(sys.argv[1]))
    for number in END_SIGNALS:  # they reach the children, too; the parent says what becomes of this process
        signal.signal(number, signal.SIG_IGN)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    children: dict[int, socket.socket] = {}
    adopt_orphans()
    while True:
        watched: list[Any] = [control, woken, *children.values()]
        ready = select.select(watched, [], [])[0]
        if woken in ready:
            os.read(woken, MAX_MESSAGE_BYTES)
            _reap(children)
        for pid, status in children.items():
            if status in ready:  # the parent no longer needs it
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        if control in ready:
            message, fds, *_ = socket.recv_fds(control, MAX_MESSAGE_BYTES, MAX_DESCRIPTORS)
            if not message:
                _end_all(children)
                return
            _start(json.loads(message), fds, children, [control.fileno(), woken, wake])


def _reap(children: dict[int, socket.socket]) -> None:
    """Report the exit status of each child that has ended."""
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            status = children.pop(ended[0], None)
            if status is not None:
                with contextlib.suppress(OSError):
                    status.sendall(f"{os.waitstatus_to_exitcode(ended[1])}\n".encode())
                status.close()
    _end_strays(children)


def _end_strays(children: Mapping[int, socket.socket]) -> None:
    """Kill what is left of children that have ended."""
    for stray in psutil.Process().children():
        if stray.pid not in children:
            with contextlib.suppress(psutil.NoSuchProcess):
                stray.kill()


def _end_all(children: Mapping[int, socket.socket]) -> None:
    """Kill all children and what they leave, which shows once they have ended; this may take a while."""
    for pid in children:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, 0)[0]:
            _end_strays({})


def _start(preload: list[str], fds: list[int], children: dict[int, socket.socket], own: list[int]) -> None:
    """Import what a child needs and fork it; import alone where there is no child yet."""
    for name in preload:
        with contextlib.suppress(Exception):  # the child meets it again, and says it
            importlib.import_module(name)
    if not fds:
        return
    gc.collect()
    gc.freeze()
    talk, output, status, page = fds
    server = os.getpid()
    pid = os.fork()
    if pid:
        children[pid] = socket.socket(fileno=status)
        for fd in (talk, output, page):
            os.close(fd)
        return
    code = 1
    try:
        die_with_parent()
        adopt_orphans()  # so that it is known whose they are: what leaves its parent stays below this child
        if os.getppid() == server:
            for fd in (status, *own, *(other.fileno() for other in children.values())):
                os.close(fd)
            _stand_alone(output)
            note_calls_on(page)
            code = _serve_requests(socket.socket(fileno=talk))
    finally:
        os._exit(code)


def _stand_alone(output: int) -> None:
    """Undo what the server set up, and send whatever is printed to the parent's pipe."""
    signal.set_wakeup_fd(-1)
    for number in (*END_SIGNALS, signal.SIGCHLD):
        signal.signal(number, signal.SIG_DFL)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for fd, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(fd, target)
    os.close(nothing)
    os.close(output)
    sys.stdout = os.fdopen(1, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)


def _serve_requests(talk: socket.socket) -> int:
    """Answer request after request until there are no more."""
    requests, answers = talk.makefile("r", encoding="utf-8"), talk.makefile("w", encoding="utf-8")
    _apply_environment(json.loads(requests.readline()))
    engine_calls.listen(lambda doing: _note_engine_call(answers, doing))
    for line in requests:
        request = json.loads(line)
        with _forward_warnings(answers):
            answer = _answer(request, answers)
        _flush()
        _send(answers, answer)
    return 0


def _note_engine_call(answers: IO[str], doing: engine_calls.EngineCall | None) -> None:
    """Report a call of an engine, and let the kernel end this process when it takes too long.

    No thread of Python could: a library that hangs may never let one run.
    """
    if signal.getsignal(signal.SIGALRM) == signal.SIG_DFL:  # a policy may use it
        signal.setitimer(signal.ITIMER_REAL, limit("engine_seconds") if doing else 0)
    _send(answers, {"doing": doing})


def _apply_environment(parent: dict[str, Any]) -> None:
    """Take over the parent's directory, variables, module path and processors."""
    os.chdir(parent["folder"])
    os.environ.clear()
    os.environ.update(parent["environment"])
    sys.path[:] = parent["path"]
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, parent["processors"])
    trust.restore(parent["named"])
    if "numpy" in sys.modules:  # or all children would draw the same numbers
        sys.modules["numpy"].random.seed()


def _answer(request: dict[str, Any], answers: IO[str]) -> dict[str, Any]:
    """Run a call; return its result, or the record of its error."""

    def tell(what: str, share: float | None) -> None:
        _send(answers, {"progress": [what, share]})

    try:
        return {"result": _function(request["call"])(request["job"], tell)}
    except BaseException as error:  # the seam: a user's code may raise anything
        record = error_record(error)
        if os.environ.get("VLATOOL_DEBUG") and (not record or ("error" in record and error.__cause__ is not None)):
            traceback.print_exc()
        return record or _raised_record(error)


def _raised_record(error: BaseException) -> dict[str, Any]:
    lines = message_of(error).strip().splitlines()
    told = {"raised": type(error).__name__, "message": lines[0] if lines else "", "ours": isinstance(error, Exception)}
    return {**told, "where": _bug_location(error) if isinstance(error, Exception) else ""}


def _bug_location(error: BaseException) -> str:
    """Return the function of vlatool that raised an exception itself; empty where other code did."""
    frame = [frame for frame, _ in traceback.walk_tb(error.__traceback__)][-1]
    module = str(frame.f_globals.get("__name__", ""))
    return f"{module}.{frame.f_code.co_name}" if module.startswith("vlatool.") else ""


def _function(name: str) -> Callable[..., Any]:
    """Return a function of vlatool by ``module:name``."""
    module, _, function = name.partition(":")
    if not module.startswith("vlatool."):
        raise ValueError(f"{name} is not a function of vlatool")
    called: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return called


@contextlib.contextmanager
def _forward_warnings(answers: IO[str]) -> Iterator[None]:
    """Forward warnings to the parent, which shows each once."""
    before = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, UserWarning):
            _send(answers, {"warning": str(message)})
        else:
            before(message, category, *where, **more)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before


def _flush() -> None:
    """Flush the output, so that it arrives before the answer."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).fflush(None)


def _send(answers: IO[str], line: dict[str, Any]) -> None:
    answers.write(json.dumps(line) + "\n")
    answers.flush()


if __name__ == "__main__":
    main()
