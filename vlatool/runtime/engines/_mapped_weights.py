"""Weights that an engine maps from a file are given back once it has a copy of its own.

OpenVINO (2026.4) maps weights beside a graph, packs a copy in the layout of its kernels while it compiles, and keeps
the mapping. Its pages are those of the file, so that they can be dropped: what is still read from them, such as a table
of embeddings, is read from the file again.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

MAPS = Path("/proc/self/maps")
MADV_DONTNEED = 4
"""``madvise(2)``: of a mapping that cannot be written, the pages are dropped and nothing is lost."""


def drop_mapped_pages(folder: Path) -> int:
    """Drop the pages of mappings of the files in a directory that cannot be written; return their bytes.

    Nothing is done where the kernel does not list mappings.
    """
    dropped = 0
    with contextlib.suppress(OSError, AttributeError):
        files = {(entry.stat().st_dev, entry.inode()) for entry in os.scandir(folder) if entry.is_file()}
        advise = ctypes.CDLL(None, use_errno=True).madvise
        for line in MAPS.read_text(encoding="utf-8", errors="replace").splitlines():
            span, access, _, device, inode, *_ = line.split(maxsplit=5)
            major, minor = (int(part, 16) for part in device.split(":"))
            if "w" in access or (os.makedev(major, minor), int(inode)) not in files:
                continue
            start, end = (int(part, 16) for part in span.split("-"))
            if not advise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), MADV_DONTNEED):
                dropped += end - start
    return dropped
