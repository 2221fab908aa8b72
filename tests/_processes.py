"""The processes below one."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

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


def environment_at_start(number: int) -> dict[str, str]:
    """Environment that a process was started with.

    Linux shows none between the moment in which ``subprocess.Popen`` returns and the one in which the new program has
    its stack (``begin_new_exec`` closes the descriptor that ``Popen`` waits for before ``create_elf_tables``).
    """
    end = time.monotonic() + 20
    content = b""
    while not content and time.monotonic() < end:
        content = Path(f"/proc/{number}/environ").read_bytes()
    return dict(os.fsdecode(each).partition("=")[::2] for each in content.split(b"\0") if each)
