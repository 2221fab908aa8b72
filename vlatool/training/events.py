"""The course of a training as events that TensorBoard reads, where they are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.errors import OutputError, require


class Events:
    """Writes scalars into a folder; does nothing without one.

    Args:
        folder: where the events are; empty for none.
        step: step from which events are written; what an earlier run wrote for later steps is discarded.

    Raises:
        MissingExtra: when tensorboard is not installed.
        OutputError: when the folder cannot be written.
    """

    def __init__(self, folder: str, step: int) -> None:
        self._writer: Any = None
        if folder:
            check_events(folder)
            writer = require("torch.utils.tensorboard", "tensorboard").SummaryWriter
            self._writer = writer(folder, purge_step=step + 1)

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Write scalars of a step: name -> value."""
        for name, value in values.items() if self._writer is not None else ():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Write what is not on the disk yet."""
        if self._writer is not None:
            self._writer.close()


def check_events(folder: str) -> None:
    """Refuse a folder that cannot be written, or a lack of tensorboard, before the work; raises as ``Events``."""
    path = Path(folder)
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file; events are written into a directory.", "name another one: --events DIR")
    require("torch.utils.tensorboard", "tensorboard")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be made: {error.strerror}.", "name another directory: --events DIR"
        ) from error
