"""Parts of a large file: how they are computed and written."""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.quantize.streamed._block_quantization import Scratch
from vlatool.runtime.interface import Array
from vlatool.weights.shards import PAGE, Reader, open_direct

O_DIRECT = getattr(os, "O_DIRECT", 0)


@dataclass
class Tools:
    """Resources of one process, reused from record to record: ``buffer`` is page-aligned memory for one."""

    reader: Reader = field(default_factory=Reader)
    scratch: Scratch = field(default_factory=Scratch)
    buffer: mmap.mmap | None = None

    def record(self, size: int) -> Array:
        """Return (size,) uint8 zeros in memory fit for direct I/O."""
        if self.buffer is None or len(self.buffer) < size:
            self.buffer = mmap.mmap(-1, size)
        data = np.frombuffer(self.buffer, np.uint8, size)
        data[:] = 0
        return data


Fill = Callable[[Tools, Array], dict[str, Any]]
"""Function that fills the zeroed bytes of a record, (size,) uint8, and returns its figures as JSON values."""


@dataclass(frozen=True)
class Record:
    """One part of the file.

    Args:
        name: Name of the tensor or layer, for progress and messages.
        size: Size in bytes; a multiple of the page size, for direct I/O.
        fill: Function that computes it; a ``Job`` when it is portable.
        weights: Number of parameters that it covers, for the progress.
        portable: Whether another process can compute it.
        verb: Past participle of the work, for the progress.
    """

    name: str
    size: int
    fill: Fill
    weights: int = 0
    portable: bool = True
    verb: str = "quantized"


def round_to_page(size: int) -> int:
    """Return ``size`` rounded up to whole pages."""
    return -(-size // PAGE) * PAGE


def compute_record(fill: Fill, size: int, file: Path, offset: int, tools: Tools) -> dict[str, Any]:
    """Compute one record, write it at its offset, and return its figures.

    Raises:
        OSError: when the disk is full.
        VlatoolError: what ``fill`` raises.
    """
    data = tools.record(size)
    note = fill(tools, data)
    handle = open_direct(file, os.O_WRONLY | os.O_CREAT)
    try:
        _write(handle, data.data, offset)
    finally:
        os.close(handle)
    return note


def _write(handle: int, view: memoryview, offset: int) -> None:
    """Write whole pages; through the page cache where the file system or a short write rules out direct I/O."""
    done = 0
    while done < len(view):
        try:
            done += os.pwrite(handle, view[done:], offset + done)
        except OSError as error:
            if error.errno != errno.EINVAL or not (O_DIRECT and fcntl.fcntl(handle, fcntl.F_GETFL) & O_DIRECT):
                raise
            _disable_direct_io(handle)
        if done % PAGE:
            _disable_direct_io(handle)


def _disable_direct_io(handle: int) -> None:
    fcntl.fcntl(handle, fcntl.F_SETFL, fcntl.fcntl(handle, fcntl.F_GETFL) & ~O_DIRECT)
