"""A record of what a process does to files, and the states that a power cut may leave of it.

The model is that of ALICE (Pillai et al., OSDI 2014) for a file system without any order: a write of a file is on the
disk once that file was flushed, a change of a directory once that directory was flushed. Of the others, any subset may
be there; a write that is not may have left zeros.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("open", "write", "fsync", "close", "replace", "rename", "unlink", "mkdir", "rmdir")


@dataclass(frozen=True)
class Change:
    """One change: ``kind`` is create, mkdir, remove, rename, truncate or write; ``inode`` is what has to be flushed."""

    kind: str
    inode: int
    name: str = ""
    other: str = ""
    target: int = 0
    content: bytes = b""


@dataclass
class Disk:
    """Directories and files by number; 0 is the root.

    Args:
        folders: number of a directory -> name -> number.
        files: number of a file -> content.
    """

    folders: dict[int, dict[str, int]] = field(default_factory=lambda: {0: {}})
    files: dict[int, bytes] = field(default_factory=dict)

    def apply(self, change: Change, *, zeros: bool = False) -> None:
        """Do one change; of a write whose data was lost, only its length arrives."""
        folder = self.folders.setdefault(change.inode, {}) if change.kind not in ("truncate", "write") else {}
        if change.kind == "create":
            folder[change.name] = change.target
            self.files.setdefault(change.target, b"")
        elif change.kind == "mkdir":
            folder[change.name] = change.target
            self.folders.setdefault(change.target, {})
        elif change.kind == "remove":
            folder.pop(change.name, None)
        elif change.kind == "rename":
            folder.pop(change.name, None)
            folder[change.other] = change.target
        elif change.kind == "truncate":
            self.files[change.inode] = b""
        else:
            content = bytes(len(change.content)) if zeros else change.content
            self.files[change.inode] = self.files.get(change.inode, b"") + content

    def copy(self) -> Disk:
        """Return a copy."""
        return Disk({number: dict(names) for number, names in self.folders.items()}, dict(self.files))

    def write_to(self, place: Path, folder: int = 0) -> None:
        """Write a directory and all below it to a real one."""
        place.mkdir()
        for name, number in self.folders[folder].items():
            if number in self.folders:
                self.write_to(place / name, number)
            else:
                (place / name).write_bytes(self.files.get(number, b""))

    @classmethod
    def of(cls, root: Path) -> Disk:
        """Return what a real directory holds."""
        disk = cls()
        numbers = {root: 0}
        for folder, folders, files in os.walk(root):
            for name in (*folders, *files):
                path, number = Path(folder) / name, len(numbers)
                numbers[path] = number
                disk.folders[numbers[Path(folder)]][name] = number
                if name in folders:
                    disk.folders[number] = {}
                else:
                    disk.files[number] = path.read_bytes()
        return disk


class Recorder:
    """Records the calls of this process below a directory while they are really done."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.start = Disk.of(root)
        self.steps: list[Change | int] = []
        """Changes, and the number of what was flushed."""
        self._now = self.start.copy()
        self._handles: dict[int, int] = {}
        self._next = 10**6

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record what happens in the block."""
        with pytest.MonkeyPatch.context() as patch:
            for name in NAMES:
                patch.setattr(os, name, self._wrapped(name, getattr(os, name)))
            yield

    def _wrapped(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*words: Any, **named: Any) -> Any:
            found = real(*words, **named)
            if not named.get("dir_fd"):
                getattr(self, f"_on_{name}")(found, *words)
            return found

        return call

    def _place(self, path: Any) -> tuple[int, str, int | None] | None:
        """Return the number of the directory of a path, its name and its own number; None outside of the root."""
        if isinstance(path, int) or not Path(path).is_relative_to(self.root):
            return None
        number = 0
        *folders, name = Path(path).relative_to(self.root).parts or ("",)
        for part in folders:
            number = self._now.folders[number][part]
        return (number, name, self._now.folders[number].get(name)) if name else (0, "", 0)

    def _do(self, change: Change) -> None:
        self.steps.append(change)
        self._now.apply(change)

    def _on_open(self, handle: int, path: Any, flags: int = 0, *_mode: int) -> None:
        place = self._place(path)
        if place is None:
            return
        folder, name, number = place
        if number is None:
            number = self._number()
            self._do(Change("create", folder, name, target=number))
        elif flags & os.O_TRUNC:
            self._do(Change("truncate", number))
        self._handles[handle] = number

    def _number(self) -> int:
        self._next += 1
        return self._next

    def _on_write(self, count: int, handle: int, data: Any) -> None:
        if handle in self._handles:
            self._do(Change("write", self._handles[handle], content=bytes(data)[:count]))

    def _on_fsync(self, _none: None, handle: int) -> None:
        if handle in self._handles:
            self.steps.append(self._handles[handle])

    def _on_close(self, _none: None, handle: int) -> None:
        self._handles.pop(handle, None)

    def _on_replace(self, _none: None, source: Any, target: Any) -> None:
        old, new = self._place(source), self._place(target)
        if old and new:
            assert old[0] == new[0], "a rename between directories is not in the model"
            assert old[2] is not None
            self._do(Change("rename", old[0], old[1], new[1], old[2]))

    _on_rename = _on_replace

    def _on_unlink(self, _none: None, path: Any) -> None:
        if place := self._place(path):
            self._do(Change("remove", place[0], place[1]))

    _on_rmdir = _on_unlink

    def _on_mkdir(self, _none: None, path: Any, *_mode: int) -> None:
        if place := self._place(path):
            self._do(Change("mkdir", place[0], place[1], target=self._number()))


def states(recorder: Recorder, draws: int, seed: int, *, flushed: bool = True) -> Iterator[tuple[int, Disk]]:
    """Yield the number of steps before a power cut, and what it may leave on the disk.

    Args:
        draws: random subsets of the changes that were not flushed, beside none, all, all but one and one alone.
        flushed: whether flushes count; without them, a control shows that the states are those of a bad order.
    """
    draw = random.Random(seed)
    for cut in range(len(recorder.steps) + 1):
        changes = [step for step in recorder.steps[:cut] if isinstance(step, Change)]
        pending = _pending(recorder.steps[:cut]) if flushed else list(range(len(changes)))
        for lost in _subsets(pending, draws, draw):
            for zeros in (False, True) if any(changes[number].kind == "write" for number in lost) else (False,):
                disk = recorder.start.copy()
                for number, change in enumerate(changes):
                    if number not in lost or (zeros and change.kind == "write"):
                        disk.apply(change, zeros=number in lost)
                yield cut, disk


def _pending(steps: list[Change | int]) -> list[int]:
    """Return the numbers of the changes that no later step flushed."""
    pending: dict[int, Change] = {}
    count = 0
    for step in steps:
        if isinstance(step, Change):
            pending[count] = step
            count += 1
        else:
            pending = {number: change for number, change in pending.items() if change.inode != step}
    return list(pending)


def _subsets(pending: list[int], draws: int, draw: random.Random) -> set[frozenset[int]]:
    """Return sets of changes that are lost."""
    everything = frozenset(pending)
    found = {frozenset(), everything}
    found |= {frozenset([one]) for one in pending} | {everything - {one} for one in pending}
    return found | {frozenset(one for one in pending if draw.random() < 0.5) for _ in range(draws if pending else 0)}
