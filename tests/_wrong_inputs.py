"""The table of what a person can get wrong: what a row is, how it is run, and what must hold after each.

After each: the exit code, the message, no traceback, and the folder of the output is as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from vlatool.cli import main

Line = list[Any]


class Place:
    """A temporary folder in which wrong things are made; ``out`` is where a command is told to write."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.place = root / "place"
        self.place.mkdir()
        self.out = self.place / "out"
        self.kept = [self.place]

    def file(self, name: str, content: str | bytes) -> Path:
        """Write a file beside the folder of the output, or into it."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def taken(self) -> Line:
        """``-o`` and an output that exists already."""
        self.out.mkdir()
        (self.out / "precious").write_text("keep me")
        return ["-o", self.out]

    def snapshot(self) -> dict[str, bytes | None]:
        """Everything in the folders that must stay as they are, hidden or not."""
        return {
            path.relative_to(self.root).as_posix(): path.read_bytes() if path.is_file() else None
            for folder in self.kept
            for path in sorted(folder.rglob("*"))
        }


def here(at: Any, line: Line) -> tuple[Any, str]:
    """Run a command line in this process; pytest has what it prints on stderr."""
    with pytest.raises(SystemExit) as caught:
        main([str(part) for part in line])
    return caught.value.code, ""


class Row(NamedTuple):
    """One mistake.

    Args:
        name: What is wrong.
        says: A part of the message; parts that follow each other with words between them are joined by `` ... ``.
        code: The exit code.
        line: Makes the wrong thing in a ``Place``, and returns the command line, or whatever ``run`` takes.
        run: Returns the exit code, and what is known of stderr.
    """

    name: str
    says: str
    code: int
    line: Callable[[Any], Any]
    run: Callable[[Any, Any], tuple[Any, str]] = here


def check(row: Row, at: Place, stderr: Callable[[], str]) -> None:
    """Get something wrong, and look at what is said and left."""
    line = row.line(at)
    before = at.snapshot()
    code, told = row.run(at, line)
    told += stderr()
    said = " ".join(told.split())
    assert (code, [part for part in row.says.split(" ... ") if part not in said]) == (row.code, []), told
    assert "Traceback" not in told
    assert "internal error" not in told
    assert at.snapshot() == before, "nothing is left behind"
