"""The output of a child, shown to the user, and its last line for errors."""

from __future__ import annotations

import contextlib
import sys

from vlatool.user_code._answers import ChildState, plain

MAX_LINES, MAX_CHARACTERS = 200, 400
"""Of what a child prints."""
BLOCK_BYTES = 1 << 16


class ChildOutput:
    """Shows the output of a child on standard error, up to a number of lines."""

    def __init__(self, about: str, last: ChildState) -> None:
        self._about, self._last, self._rest, self._shown = about, last, b"", 0

    def take(self, printed: bytes) -> None:
        """Show the lines that are whole now."""
        *lines, self._rest = (self._rest + printed).split(b"\n")
        if len(self._rest) > BLOCK_BYTES:
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            self._show(plain(line.decode("utf-8", "replace")))

    def _show(self, line: str) -> None:
        self._last.said = line.strip() or self._last.said
        if not line.strip() or self._shown > MAX_LINES:
            return
        self._shown += 1
        line = line[:MAX_CHARACTERS] if self._shown <= MAX_LINES else "prints more; not shown"
        with contextlib.suppress(OSError, ValueError, AttributeError):
            sys.stderr.write(f"[{self._about}] {line}\n")
            sys.stderr.flush()
