"""The other processes of a training: launched (by torchrun, or here), called, and ended by the first one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from vlatool.errors import RecipeError, SourceError, VlatoolError
from vlatool.files.printable import amount
from vlatool.training.group import LOST_PROCESS, RUN_AGAIN, Group, join_group
from vlatool.training.torchrun import PRELOAD, RENDEZVOUS, Follower, Launch, current_launch, open_store, write_token
from vlatool.user_code.children import Child

MODULE = "vlatool.training.rank_process"
GRACE_S = 5.0
"""Seconds in which a lost process may report its error, before the others are ended."""


class RankProcesses:
    """The other processes of a training, which take the same steps on other rows; none where it is one process.

    Args:
        children: processes with the ranks from 1 on.
        threads: one for each, which waits for it.
    """

    def __init__(self, children: Sequence[Child | Follower] = (), threads: ThreadPoolExecutor | None = None) -> None:
        self.group = Group(0, len(children) + 1)
        self._children, self._threads = children, threads
        self._errors: list[BaseException] = []

    @contextlib.contextmanager
    def calling(self, function: str, job: Mapping[str, Any]) -> Iterator[None]:
        """Call a function of ``rank_process`` in all others during the block; raises the error, or end, of one."""
        calls = [self._submit(child, function, {**job, "rank": rank}) for rank, child in enumerate(self._children, 1)]
        try:
            yield
        except SourceError as error:
            if error.message != LOST_PROCESS:
                raise
            self._end(calls)
            raise self._cause(error) from error
        if self._end(calls, wait=True):
            raise self._cause(self._errors[0])

    def _submit(self, child: Child | Follower, function: str, job: Mapping[str, Any]) -> Future[None]:
        if self._threads is None:
            raise RuntimeError("several processes need threads")
        return self._threads.submit(self._call, child, function, job)

    def _call(self, child: Child | Follower, function: str, job: Mapping[str, Any]) -> None:
        try:
            child.call(f"{MODULE}:{function}", job, lambda _what, _share: None)
        except BaseException as error:  # reported in the first process; the others would wait for this one forever
            self._errors.append(error)
            child.end()

    def _end(self, calls: Sequence[Future[None]], *, wait: bool = False) -> bool:
        """Wait for all calls, ending the processes first unless they shall come to an end; say whether any failed."""
        if not wait:  # the lost process is about to report how it ended
            futures.wait(calls, timeout=GRACE_S, return_when=futures.FIRST_COMPLETED)
        for child in () if wait else self._children:
            child.end()
        for call in calls:
            call.result()
        return bool(self._errors)

    def _cause(self, error: BaseException) -> BaseException:
        """Return the error that came first, not one of those that followed from it; of a kill, how to go on."""
        first = next((each for each in self._errors if LOST_PROCESS not in str(each)), error)
        if not isinstance(first, VlatoolError) or "(SIG" not in first.message:
            return first
        return type(first)(first.message, "; ".join(filter(None, dict.fromkeys((first.fix, RUN_AGAIN)))))


@contextlib.contextmanager
def launch_processes(
    job: Mapping[str, Any], size: int, folder: Path, about: str, device: str = "cpu"
) -> Iterator[RankProcesses]:
    """Yield the processes of a training, including this one, with the student loaded in each.

    Args:
        job: argument of ``rank_process.load``.
        size: how many processes there are with this one.
        about: name of the code that they run.

    Raises:
        RecipeError: when torchrun started another number of processes.
    """
    launch = current_launch()
    check_launch(launch, size)
    if size == 1:
        yield RankProcesses()
        return
    (folder / RENDEZVOUS).unlink(missing_ok=True)
    job = {**job, "place": str(folder), "size": size, **(write_token(folder) if launch else {})}
    with contextlib.ExitStack() as opened:
        threads = opened.enter_context(ThreadPoolExecutor(size - 1))
        others: list[Child | Follower] = []
        for rank in range(1, size):
            other = Follower(launch, rank) if launch else Child(f"{about}, process {rank + 1} of {size}", PRELOAD)
            opened.enter_context(other)
            others.append(other)
        processes = RankProcesses(others, threads)
        with processes.calling("load", job):
            pass
        store, here = open_store(job)
        with processes.calling("join", job):
            opened.enter_context(join_group(store, processes.group, device, here=here))
        yield processes


def check_launch(launch: Launch | None, size: int) -> None:
    """Refuse, with RecipeError, a number of processes that is not torchrun's, and other processes than the first."""
    if launch is not None and (launch.size != size or launch.rank):
        raise RecipeError(
            f"torchrun started {amount(launch.size, 'process')}, of which this is number {launch.rank + 1}; the "
            f"training was asked for {size}, by the first one.",
            "leave --processes out: torchrun says how many there are",
        )
