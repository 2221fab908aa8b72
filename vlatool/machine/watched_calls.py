"""A watchdog for calls that may never return: they are noted on a page of shared memory that the parent reads.

A child writes what it calls and since when; its parent reads that, says what it waits for, and ends the child when the
call takes longer than it may (``vlatool.user_code.children``). A process whose page nobody reads calls as ever.
"""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass

PAGE_BYTES = 1 << 11
"""Bytes of a page; below limits on the size of files (``ulimit -f``), which count it."""
HEAD = struct.Struct("<ddI")
"""When the call began (``time.monotonic``; 0 for none), how long it may take, in seconds, and bytes of its words."""


@dataclass(frozen=True)
class Call:
    """A call that is under way.

    Args:
        waiting: what is waited for, for the progress: ``reset() of seed 17``.
        whose: what did not return, the start of a sentence.
        at: when it was called, the end of a sentence; may be empty.
        fix: what to do where it takes too long.
        limit_s: how long it may take.
        begun: ``time.monotonic`` when it began.
    """

    waiting: str
    whose: str
    at: str
    fix: str
    limit_s: float
    begun: float


class Page:
    """The page at the descriptor of ``new_page``, which stays open, as both processes see it."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, PAGE_BYTES)
        self._words = b""

    def begin(self, waiting: str, whose: str, at: str, fix: str, limit_s: float) -> None:
        """Note a call."""
        words = _truncate_to_fit([waiting, whose, at, fix])
        if words != self._words:
            self._memory[HEAD.size : HEAD.size + len(words)] = self._words = words
        HEAD.pack_into(self._memory, 0, time.monotonic(), limit_s, len(words))

    def end(self) -> None:
        """Note that it has returned."""
        HEAD.pack_into(self._memory, 0, 0.0, 0.0, 0)

    def read(self) -> Call | None:
        """Return the call that is under way, None for none, and for invalid content: user code may write it."""
        begun, limit_s, length = HEAD.unpack_from(self._memory, 0)
        if not (begun > 0 and limit_s > 0 and math.isfinite(begun) and length <= PAGE_BYTES - HEAD.size):
            return None
        try:
            words = json.loads(self._memory[HEAD.size : HEAD.size + length].decode())
        except ValueError:
            return None
        if not (isinstance(words, list) and len(words) == 4 and all(isinstance(word, str) for word in words)):
            return None
        waiting, whose, at, fix = words
        return Call(waiting, whose, at, fix, limit_s, begun)

    def close(self) -> None:
        """Give the page up."""
        self._memory.close()


def _truncate_to_fit(texts: list[str]) -> bytes:
    """Return texts as JSON that fits on a page, each cut short where they do not: a task may have any name."""
    length = PAGE_BYTES
    while len(words := json.dumps([text[:length] for text in texts]).encode()) > PAGE_BYTES - HEAD.size:
        length //= 2
    return words


_page: Page | None = None


def new_page() -> int:
    """Return the descriptor of an empty page that another process may be given."""
    fd = os.memfd_create("vlatool-calls", os.MFD_CLOEXEC)
    os.ftruncate(fd, PAGE_BYTES)
    return fd


def note_calls_on(fd: int) -> None:
    """Let calls of this process be noted on a page."""
    global _page
    _page = Page(fd)
    os.close(fd)


@contextlib.contextmanager
def watched_call(waiting: str, whose: str, at: str, fix: str, limit_s: float) -> Iterator[None]:
    """Note the block as a call on the page; see ``Call``."""
    if _page is None:
        yield
        return
    _page.begin(waiting, whose, at, fix, limit_s)
    try:
        yield
    finally:
        _page.end()
