"""A training whose processes torchrun started, on one machine or several: who this one is, and how they talk.

The first process (``RANK`` 0) runs the whole command. The others follow it: they wait for calls of ``rank_process``,
which the first one writes into torchrun's store (``MASTER_ADDR``, ``MASTER_PORT``), and write back how each ended.
Rows, bundles and checkpoints are files of the first process, which all must see under the same path.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

from vlatool import errors
from vlatool.errors import InputError, MissingExtra, RecipeError, SourceError, VlatoolError, require
from vlatool.files.printable import message_of, one_line
from vlatool.machine.version import VERSION
from vlatool.user_code.children import Child

VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
"""Environment variables that torchrun sets for each process."""
AGENT = "TORCHELASTIC_USE_AGENT_STORE"
RENDEZVOUS = "meeting"
"""File in the folder of the training through which processes of one machine find each other; under torchrun it holds
what shows that a process sees that folder."""
OPTIMIZER = "torch._dynamo"
"""What the first optimizer of a process imports, for a second of its time."""
PRELOAD = ("torch", OPTIMIZER, "vlatool.training.rank_process")
LEAVE_CALL = "leave"
"""Call after which a process discards the training."""
START_S, LEFT_S, POLL_S = 300.0, 5.0, 0.05
"""Seconds in which another process comes, and goes; and between two looks at the store."""
LOOPBACK = ("127.", "localhost", "::1")
RUN_AGAIN = "run the same command again on all machines: it goes on from the last checkpoint"
SHARE_CACHE = "let all machines see one cache under the same path (VLATOOL_CACHE=FOLDER on a shared file system)"


@dataclass(frozen=True)
class Launch:
    """Which of torchrun's processes this one is.

    Args:
        rank, size: its number of all processes.
        local_rank, local_size: the same of those on its machine.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    address: str
    port: int

    @property
    def on_one_machine(self) -> bool:
        """Whether all processes are on this machine."""
        return self.size == self.local_size or self.address.startswith(LOOPBACK)

    def store(self, prefix: str = "vlatool", *, host: bool = False) -> Any:
        """Open the store.

        Args:
            prefix: prefix of all names in it.
            host: whether this process serves it, unless torchrun does.

        Raises:
            SourceError: when it does not answer.
        """
        distributed = require("torch.distributed", "build")
        host = host and os.environ.get(AGENT) != "True"
        try:
            store = distributed.TCPStore(self.address, self.port, None, host, timedelta(seconds=START_S), False)
        except RuntimeError as error:
            raise SourceError(
                f"The store of torchrun at {self.address}:{self.port} does not answer: {one_line(message_of(error))}",
                "look at --master-addr and --master-port (or --rdzv-endpoint), and at firewalls between the machines",
            ) from error
        return distributed.PrefixStore(prefix, store)


def current_launch() -> Launch | None:
    """Return this process's place among those of torchrun; None without torchrun, or for a single process.

    Raises:
        RecipeError: when the variables are incomplete, or not numbers.
    """
    said = {name: os.environ.get(name, "") for name in VARIABLES}
    if not (said["RANK"] and said["WORLD_SIZE"]) or said["WORLD_SIZE"] == "1":
        return None
    missing = [name for name, value in said.items() if not value]
    numbers = [name for name in VARIABLES if name != "MASTER_ADDR" and not said[name].isdecimal()]
    if missing or numbers:
        name = (missing or numbers)[0]
        raise RecipeError(
            f"RANK and WORLD_SIZE are set, as torchrun does, and {name} is {said[name] or 'not set'!r}.",
            f"torchrun sets {', '.join(VARIABLES)}; set all of them, or unset RANK and WORLD_SIZE",
        )
    rank, size, local_rank, local_size = (int(said[name]) for name in VARIABLES[:4])
    if not (rank < size and local_rank < local_size <= size):
        raise RecipeError(
            f"RANK={rank} of WORLD_SIZE={size} (LOCAL_RANK={local_rank} of LOCAL_WORLD_SIZE={local_size}) is not "
            "a process of torchrun's: each rank is below its size.",
            "unset RANK and WORLD_SIZE",
        )
    return Launch(rank, size, local_rank, local_size, said["MASTER_ADDR"], int(said["MASTER_PORT"]))


def versions() -> dict[str, str]:
    """Return the versions that must be the same in all processes."""
    return {"vlatool": VERSION, "torch": str(require("torch", "build").__version__)}


def write_token(folder: Path) -> dict[str, Any]:
    """Write a token into the folder of the training; return it with the versions, for other processes to check."""
    token = secrets.token_hex(8)
    (folder / RENDEZVOUS).write_text(token)
    return {"token": token, "versions": versions()}


def check_shared(job: Mapping[str, Any]) -> None:
    """Refuse, with RecipeError, to train where the first process's folder is not visible, or versions differ."""
    if "token" not in job:
        return
    who, seen = f"Process {job['rank'] + 1} of {job['size']} on {platform.node()}", Path(job["place"], RENDEZVOUS)
    for name, theirs in job["versions"].items():
        if (ours := versions()[name]) != theirs:
            raise RecipeError(f"{who} runs {name} {ours}, the first process {theirs}.", "install the same versions")
    try:
        same = seen.read_text() == job["token"]
    except OSError:
        same = False
    if not same:
        raise RecipeError(f"{who} does not see the folder in which the first process keeps rows and checkpoints: "
                          f"{seen.parent}.", SHARE_CACHE)  # fmt: skip


def open_store(job: Mapping[str, Any]) -> tuple[Callable[[], Any], bool]:
    """Return a function that opens the store of a training's group, and whether all processes are on this machine."""
    launch = current_launch()
    if launch is not None:
        return partial(launch.store, f"vlatool-{job['token']}"), launch.on_one_machine
    store = require("torch.distributed", "build").FileStore
    return partial(store, str(Path(job["place"]) / RENDEZVOUS), job["size"]), True


class Follower:
    """A process that follows this one, as ``Child`` is one that it started: it calls functions of ``rank_process``."""

    def __init__(self, launch: Launch, rank: int) -> None:
        self._store, self._rank, self._lost = launch.store(), rank, threading.Event()
        self._who = f"Process {rank + 1} of {launch.size}"

    def __enter__(self) -> Follower:
        """Wait until the process is ready.

        Raises:
            SourceError: when it does not start.
            VlatoolError: an error that it raised before.
        """
        self._wait("here", time.monotonic() + START_S)
        return self

    def __exit__(self, kind: object, *_exception: object) -> None:
        if kind is None:
            self._send_call(LEAVE_CALL, {})

    def call(self, function: str, job: Mapping[str, Any], _tell: Any) -> None:
        """Call a function in the process, and wait; raises what it raises, or SourceError when the process is gone."""
        self._wait(f"answer/{self._send_call(function, job)}")

    def end(self) -> None:
        """Stop waiting for the process; may be called from any thread."""
        self._lost.set()

    def _send_call(self, function: str, job: Mapping[str, Any]) -> int:
        number = int(self._store.add(f"{self._rank}/calls", 1))
        self._store.set(f"{self._rank}/call/{number}", json.dumps({"function": function, "job": dict(job)}))
        return number

    def _wait(self, name: str, until: float = float("inf")) -> None:
        """Wait for a reply, and raise the error that it reports."""
        while not self._lost.is_set() and time.monotonic() < until:
            for key in (f"{self._rank}/failed", f"{self._rank}/{name}"):
                if self._store.check([key]):
                    self._raise_error(json.loads(self._store.get(key)))
                    return
            time.sleep(POLL_S)
        raise SourceError(f"{self._who} of the training does not answer.", RUN_AGAIN)

    def _raise_error(self, answer: Mapping[str, str] | None) -> None:
        if answer is None:
            return
        found = getattr(errors, answer["error"], None)
        known = isinstance(found, type) and issubclass(found, InputError | MissingExtra)
        kind: Callable[[str, str], VlatoolError] = found if known and found else SourceError
        raise kind(f"{self._who} ({answer['host']}): {answer['message']}", answer["fix"])


@contextlib.contextmanager
def lead(launch: Launch) -> Iterator[None]:
    """Run a command as the first process; the others end after the block."""
    store = launch.store(host=True)
    try:
        yield
    finally:
        store.set("over", "1")
        if os.environ.get(AGENT) != "True":  # this process serves the store: let them read that
            with contextlib.suppress(RuntimeError):
                store.wait([f"{rank}/left" for rank in range(1, launch.size)], timedelta(seconds=LEFT_S))


def follow(launch: Launch, about: str, ready: Callable[[], None]) -> None:
    """Serve the calls of the first process until its command has ended.

    Args:
        about: name of the training, for messages.
        ready: called first: what the command line has to check or allow here.

    Raises:
        SourceError: when the first process is gone.
        VlatoolError: what ``ready`` raises.
    """
    store, number = launch.store(), 0
    try:
        ready()
    except VlatoolError as error:
        store.set(f"{launch.rank}/failed", json.dumps(_error_record(error)))
        store.set(f"{launch.rank}/left", "1")
        raise
    store.set(f"{launch.rank}/here", "null")
    with contextlib.ExitStack() as opened:
        child: Child | None = None
        while call := _next_call(store, f"{launch.rank}/call/{(number := number + 1)}"):
            if call["function"] == LEAVE_CALL:
                opened.close()
                child = None
                continue
            if child is None:
                child = opened.enter_context(Child(f"{about}, process {launch.rank + 1} of {launch.size}", PRELOAD))
            store.set(f"{launch.rank}/answer/{number}", json.dumps(_run_call(child, launch, call)))
    store.set(f"{launch.rank}/left", "1")


def _next_call(store: Any, name: str) -> Any:
    """Wait for a call; return None when the first process's command has ended."""
    try:
        while True:
            over = store.check(["over"])
            if store.check([name]):
                return json.loads(store.get(name))
            if over:
                return None
            time.sleep(POLL_S)
    except RuntimeError as error:
        raise SourceError("The first process of the training is gone.", RUN_AGAIN) from error


def _run_call(child: Child, launch: Launch, call: Mapping[str, Any]) -> Any:
    """Run a call; return None, or the record of its error."""
    try:
        child.call(call["function"], {**call["job"], "rank": launch.rank}, lambda _what, _share: None)
    except VlatoolError as error:
        return _error_record(error)
    except (OSError, MemoryError) as error:
        return _error_record(
            SourceError(
                f"{type(error).__name__}: {one_line(message_of(error))}",
                "run it there with VLATOOL_DEBUG=1 to see where it was raised",
            )
        )
    return None


def _error_record(error: VlatoolError) -> dict[str, str]:
    return {"error": type(error).__name__, "message": error.message, "fix": error.fix, "host": platform.node()}
