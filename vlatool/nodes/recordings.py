"""Recordings of runs as a replay reads them: the log of a run, or a bag in which a node's records are beside messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from vlatool.errors import DataError
from vlatool.nodes.run_log import Item, is_log, read_log
from vlatool.nodes.step_record import ControllerRecord


@dataclass(frozen=True)
class Recording:
    """A recorded run.

    Args:
        path: The file, or the directory of a bag.
        about: What ran.
        topics: Input, output or service -> topic, where messages are listed by topic; None where by input.
    """

    path: Path
    about: ControllerRecord
    topics: Mapping[str, str] | None

    def items(self) -> Iterator[Item]:
        """Return what is in it, in order."""
        return read_log(self.path)


def open_recording(path: Path, controller: str) -> Recording:
    """Return a recorded run of a controller.

    Args:
        controller: Name of the controller.

    Raises:
        DataError: when it cannot be read, or is of another controller or of none.
    """
    if not path.exists():
        raise DataError(f"There is no recording at {path}.", "check the path")
    if not is_log(path):
        raise DataError(f"{path} is not a recorded run.", "name a file of vlatool run --record, or a bag")
    about = next((item for item in read_log(path) if isinstance(item, ControllerRecord)), None)
    if about is None:
        raise DataError(f"{path} does not say which controller ran.", "record the run again")
    if about.controller.replace("-", "_") != controller.replace("-", "_"):
        raise DataError(f"{path} was recorded with the controller '{about.controller}', not '{controller}'.",
                        f"vlatool replay {path} {about.controller}")  # fmt: skip
    return Recording(path, about, None)
