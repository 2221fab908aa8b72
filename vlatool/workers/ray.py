"""The workers of a Ray cluster, on as many machines as it has: the one file that imports ray."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import warnings
from collections import Counter, deque
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

from vlatool.errors import SourceError, TargetError, require, require_present
from vlatool.files.messages import to_json
from vlatool.files.printable import one_line
from vlatool.user_code.children import result
from vlatool.workers import Done, Note, OnProgress, Work, Workers
from vlatool.workers._file_transfer import Parcel, blocks, parcel_of
from vlatool.workers._remote_worker import Order, RemoteWorker, this_machine

ADDRESS = "RAY_ADDRESS"
MAX_ATTEMPTS = 3
"""How often a job is given to a worker that is lost with it, and how many workers in a row may not even begin."""
WAIT_S = 5.0
LOOPBACK = ("localhost", "127.0.0.1", "::1", "[::1]")
HELLO = -1
"""In the place of a job's number: a worker that has just been asked for, or is being sent what it lacks."""
INSTALL = "install vlatool with its extras, the same version, where ray runs on each machine"
START = "start one: ray start --head (on each other machine: ray start --address=HOST:PORT), or name it: RAY_ADDRESS"


class Ray(Workers):
    """Workers on an existing Ray cluster, one for each processor that is free there.

    Bundle and environment are sent to machines that lack them.
    """

    def check(self) -> None:
        """Raise when ray is not installed, or no cluster is running.

        Raises:
            MissingExtra: when ray is not installed.
            TargetError: when no cluster can be reached.
        """
        require_present("ray", "ray")
        _connect()

    def answers(self, work: Work, tell: OnProgress, done: Done, note: Note) -> Generator[Any, None, None]:
        """Yield the answers in the order of the requests."""
        workers = _RayWorkers(_connect(), work, self.count, tell, done, note)
        try:
            yield from workers.run()
        finally:
            workers.dismiss(gently=sys.exc_info()[0] is None)


def _connect() -> Any:
    """Connect this process to the cluster, once; return the library."""
    ray = require("ray", "ray")
    if ray.is_initialized():
        return ray
    address = os.environ.get(ADDRESS) or "auto"
    _refuse_unreachable(address, ray.util.get_node_ip_address())
    try:
        with _keep_signals():
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError, OSError, TimeoutError) as error:
        why = one_line(str(error), 300).rstrip(".")
        raise TargetError(f"No Ray cluster accepts this process ({ADDRESS}={address}): {why}.", START) \
            from error  # fmt: skip
    return ray


def _refuse_unreachable(address: str, own: str) -> None:
    """Say at once that nobody listens: Ray itself goes on trying for many minutes."""
    where = address
    if address == "auto":
        with contextlib.suppress(OSError):
            where = (Path(os.environ.get("RAY_TMPDIR", "/tmp")) / "ray" / "ray_current_cluster").read_text().strip()
    host, _, port = where.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        return
    host = own if host in LOOPBACK else host.strip("[]")
    try:
        with socket.create_connection((host, int(port)), timeout=WAIT_S):
            pass
    except (OSError, OverflowError) as error:
        told = f"No Ray cluster answers at {where} ({ADDRESS}={address}, looked for at {host}): {error}."
        raise TargetError(told, START) from error


@contextlib.contextmanager
def _keep_signals() -> Iterator[None]:
    """Keep what Ray would change: its workers would import from the current directory, and SIGTERM would be Ray's."""
    before = os.getcwd()
    main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGTERM)
    os.chdir("/")
    try:
        yield
    finally:
        os.chdir(before)
        if main and handler is not None:
            signal.signal(signal.SIGTERM, handler)


class _RayWorkers:
    """The workers of one piece of work, and who does which job."""

    def __init__(self, ray: Any, work: Work, most: int, tell: OnProgress, done: Done, note: Note) -> None:
        self._ray, self._work, self._tell, self._done, self._note = ray, work, tell, done, note
        self._parcels = [parcel_of(folder) for folder in work.folders]
        self._order = to_json(Order.of(work, self._parcels))
        self._sent: dict[int, list[Any]] = {}
        self._most = most
        self._waiting = deque(range(len(work.requests)))
        self._busy: dict[Any, tuple[Any, int]] = {}
        """Pending object -> the worker that it comes from, and the number of its job."""
        self._idle: list[Any] = []
        self._answers: dict[int, Any] = {}
        self._attempts: Counter[int] = Counter()
        self._begun = False
        self._told: set[str] = set()

    def run(self) -> Iterator[Any]:
        """Yield the answers in order.

        Raises:
            VlatoolError: what a job raises, once all before it are answered.
            TargetError: when no worker can begin.
        """
        count = len(self._work.requests)
        for _ in range(min(count, self._free_slots())):
            self._hire()
        for number in range(count):
            while number not in self._answers:
                self._wait()
            yield result(self._answers.pop(number), self._work.about)

    def dismiss(self, *, gently: bool) -> None:
        """End all workers; those that have nothing to do may close what they have open."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            closing = [seat.close.remote() for seat in self._idle] if gently else []
            if closing:
                self._ray.wait(closing, num_returns=len(closing), timeout=WAIT_S)
        for seat in (*self._idle, *(seat for seat, _ in self._busy.values())):
            with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.kill(seat)
        self._idle.clear()
        self._busy.clear()
        self._sent.clear()

    def _free_slots(self) -> int:
        """Return how many workers the cluster has place for."""
        slots = int(self._ray.cluster_resources().get("CPU", 0))
        if slots < 1:
            raise TargetError("The Ray cluster has no processor for a worker.", "start a node: ray start --num-cpus=N")
        return min(slots, self._most or slots)

    def _hire(self) -> None:
        """Ask for a worker; it begins when the cluster has a processor for it."""
        wanted = self._ray.remote(RemoteWorker).options(
            num_cpus=1, max_restarts=0, max_task_retries=0, scheduling_strategy="SPREAD"
        )
        seat = wanted.remote(self._order)
        self._busy[seat.hello.remote()] = seat, HELLO

    def _wait(self) -> None:
        """Wait until a worker says something, and give it something to do."""
        ready, _ = self._ray.wait(list(self._busy), timeout=WAIT_S)
        if not ready and all(number == HELLO for _, number in self._busy.values()):
            self._tell("waiting for a free processor of the Ray cluster", None)
        for said in ready:
            seat, number = self._busy.pop(said)
            try:
                answer = self._ray.get(said)
            except self._ray.exceptions.RayError as error:
                self._replace_worker(seat, number, error)
                continue
            if number == HELLO:
                self._welcome(seat, answer)
            else:
                self._accept_answer(seat, number, answer)

    def _welcome(self, seat: Any, answer: dict[str, Any]) -> None:
        """Send a new worker what it lacks; give one that lacks nothing a job."""
        if "machine" not in answer:  # the last block has arrived
            result(answer, "a worker of the Ray cluster")
        else:
            self._compare(answer["machine"])
            last = [self._send(seat, number) for number in answer["lacks"]]
            if last:
                self._busy[last[-1]] = seat, HELLO
                return
        self._begun = True
        self._next(seat)

    def _send(self, seat: Any, number: int) -> Any:
        """Send a parcel, whose blocks are put into the cluster once; return the pending object."""
        if number not in self._sent:
            parcel: Parcel = self._parcels[number]
            self._tell(f"sending {parcel.folder} to the workers", None)
            self._sent[number] = [self._ray.put(block) for block in blocks(parcel)]
        *more, last = self._sent[number]
        for block in more:
            seat.take.remote(number, block, False)
        return seat.take.remote(number, last, True)

    def _compare(self, there: dict[str, str]) -> None:
        """Say where a worker's machine would compute otherwise than this one."""
        here = this_machine()
        if there["vlatool"] != here["vlatool"]:
            raise TargetError(
                f"A worker of the Ray cluster has vlatool {there['vlatool']}, this machine {here['vlatool']}.",
                "install the same version on all machines of the cluster",
            )
        for name in dict.fromkeys((*here, *there)):
            ours, theirs = (side.get(name, "none") for side in (here, there))
            if ours != theirs:
                text = f"A worker of the Ray cluster has {name} {theirs}, this machine {ours}: what it computes may "
                text += "differ in rounding, and so may single episodes."
                if text not in self._told:
                    self._told.add(text)
                    self._note(text)

    def _accept_answer(self, seat: Any, number: int, said: dict[str, Any]) -> None:
        """Take what came of a job, and give the worker another one."""
        if said["printed"]:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                sys.stderr.write(said["printed"])
        for warning in said["warnings"]:
            warnings.warn(str(warning), UserWarning, stacklevel=2)
        for what in said["told"]:
            self._tell(what, None)
        answer = said["answer"]
        if "lost" in answer:
            self._retry(number, answer["lost"], answer["fix"])
        else:
            self._answers[number] = answer
            if "result" in answer:
                self._done(number, answer["result"])
            else:  # it is raised once all before it are answered, so that what comes after it is for nothing
                self._waiting = deque(other for other in self._waiting if other < number)
        self._next(seat)

    def _next(self, seat: Any) -> None:
        if self._waiting:
            number = self._waiting.popleft()
            self._busy[seat.answer.remote(self._work.requests[number])] = seat, number
        else:
            self._idle.append(seat)

    def _replace_worker(self, seat: Any, number: int, error: Exception) -> None:
        """Replace a worker that ended, and retry its job."""
        with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
            self._ray.kill(seat)
        why = one_line(str(error), 300).rstrip(".")
        self._tell("a worker of the Ray cluster was lost; its job is done again", None)
        if number == HELLO:
            self._attempts[HELLO] += 1
            if self._attempts[HELLO] >= MAX_ATTEMPTS and not self._begun:
                raise TargetError(f"No worker of the Ray cluster can begin: {why}.", INSTALL)
        else:
            self._retry(number, f"{self._work.about}: the worker that ran it was lost: {why}.", "")
        if self._attempts[HELLO] < MAX_ATTEMPTS * MAX_ATTEMPTS:
            self._hire()
        elif not self._busy and not self._idle:
            raise TargetError(f"The workers of the Ray cluster end before they begin: {why}.", INSTALL)

    def _retry(self, number: int, why: str, fix: str) -> None:
        """Let a job be done again, unless it took so many workers with it that the fault is its own."""
        self._attempts[number] += 1
        if self._attempts[number] >= MAX_ATTEMPTS:
            message = f"{why.rstrip('.')}, {MAX_ATTEMPTS} times in a row."
            self._answers[number] = {"error": SourceError.__name__, "message": message, "fix": fix}
            return
        self._waiting.appendleft(number)
        if self._idle:
            self._next(self._idle.pop())
