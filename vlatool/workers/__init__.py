"""Launchers of workers: child processes on this machine, or an existing cluster of several machines; one file each.

A launcher knows nothing of episodes: it calls a function of vlatool with one request after the other, each in a child
process (``vlatool.user_code.children``), and returns the answers in the order of the requests.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vlatool import registry
from vlatool.errors import PluginError, UsageError, suggest

KIND = "workers"
PROCESSES = "processes"
"""The launcher that is there without any other package."""
OnProgress = Callable[[str, float | None], None]
Done = Callable[[int, Any], None]
Note = Callable[[str], None]


@dataclass(frozen=True)
class Folder:
    """A folder whose path requests name; a worker on another machine is sent its files.

    Args:
        path: absolute.
        names: names of the files below it that are needed; all but hidden ones when empty.
    """

    path: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Work:
    """Jobs for several workers.

    Args:
        function: ``module:function`` of vlatool, called with each request, and ``tell``.
        requests: JSON values. A text that is the path of one of the folders, or begins with it, is that of the copy
            where the worker has one.
        about: name of the code that runs, for messages: ``environment.py``.
        preload: modules that the function needs.
        last: called in every child when all is done, with an empty request; nothing when empty.
        folders: what the requests name.
    """

    function: str
    requests: Sequence[Mapping[str, Any]]
    about: str
    preload: Sequence[str] = ()
    last: str = ""
    folders: tuple[Folder, ...] = ()


class Workers:
    """Base of every launcher of ``count`` workers at most; 0 for as many as there is place for."""

    def __init__(self, count: int) -> None:
        self.count = count

    def check(self) -> None:
        """Raise a user error when there is nobody to compute; cheap."""

    def answers(self, work: Work, tell: OnProgress, done: Done, note: Note) -> Generator[Any, None, None]:
        """Yield the answer to every request, in order; close the iterator to end the workers.

        Args:
            done: function called with the number of a request and its answer as soon as there is one, from any thread.
            note: function called with what a reader of the results must know of the workers, a sentence.

        Raises:
            VlatoolError: what the function raises for a request, once all before it are answered.
        """
        raise PluginError(f"The launcher {type(self).__name__} has no method answers().", "define it")


def launcher(name: str, count: int) -> Workers:
    """Return the launcher of a name; raises UsageError when there is none."""
    made: Workers = registry.load(KIND, name)(count)
    return made


def parse_workers(text: str) -> tuple[str, int]:
    """Read what a person wrote for workers: ``4`` processes, ``ray``, or ``ray:8``; return launcher and number.

    Raises:
        UsageError: for anything else.

    Example:
        >>> parse_workers("4")
        ('processes', 4)
    """
    name, _, count = text.partition(":") if not text.isdecimal() else (PROCESSES, "", text)
    if name not in registry.names(KIND):
        others = [each for each in registry.names(KIND) if each != PROCESSES]
        raise UsageError(
            f"--workers is '{text}'; it takes a number of processes, or {suggest(name, others)}.",
            "write --workers 4, or --workers ray:4",
        )
    if ":" in text or count:
        if not count.isdecimal() or int(count) < 1:
            raise UsageError(f"--workers is '{text}'; the number of workers is 1 or more.",
                             "--workers 4" if name == PROCESSES else f"--workers {name}:4")  # fmt: skip
        return name, int(count)
    return name, 0
