"""Children of this process, on this machine."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

from vlatool.user_code.children import map_jobs
from vlatool.workers import Done, Note, OnProgress, Work, Workers


class Processes(Workers):
    """Several child processes, which a server forks that has imported the libraries once."""

    def answers(self, work: Work, tell: OnProgress, done: Done, note: Note) -> Generator[Any, None, None]:
        """Yield the answers in order."""
        count = max(1, self.count)
        return map_jobs(work.function, work.requests, count, tell, work.about, work.preload, work.last, done)
