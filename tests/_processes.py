"""The processes below one."""

from __future__ import annotations

import contextlib

import psutil


def below(number: int, text: str) -> list[psutil.Process]:
    """Return those whose command line holds the text; a process that has ended has no command line."""
    found = []
    with contextlib.suppress(psutil.NoSuchProcess):
        for each in psutil.Process(number).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):  # a zombie is one too
                if text in " ".join(each.cmdline()):
                    found.append(each)
    return found
