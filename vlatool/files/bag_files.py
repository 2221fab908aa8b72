"""Files of recorded bags, for all who read them: names, what their library raises, and what to do about a broken one.

Mostly it is one whose recorder was killed before it wrote the index.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vlatool.errors import InputError, VlatoolError

SUFFIXES = (".bag", ".mcap", ".db3")
UNFINISHED_SUFFIX = ".active"
"""Behind the name of a bag that ``rosbag record`` of ROS 1 has not finished."""
MCAP_END = b"\x89MCAP0\r\n"
"""Last bytes of an mcap file that is whole (MCAP specification, "File structure")."""


@contextmanager
def bag_errors(path: Path, raised: type[InputError]) -> Iterator[None]:
    """Turn what rosbags raises on a damaged bag into an error of one sentence, of the class ``raised``."""
    try:
        yield
    except VlatoolError:
        raise
    except Exception as error:  # rosbags, sqlite3, zstd, lz4 and yaml each have errors of their own
        reason = " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
        raise raised(f"{path} cannot be read: {reason}.", bag_repair(path)) from error


def refuse_unfinished(path: Path, raised: type[InputError]) -> None:
    """Raise an error on a bag that ``rosbag record`` still writes, or left when it was killed, with what to do."""
    if path.suffix == UNFINISHED_SUFFIX:
        raise raised(
            f"{path} has no index yet: rosbag record still writes it, or was killed.",
            f"end rosbag record with Ctrl-C; if it was killed: rosbag reindex {path}, then mv {path} "
            f"{path.with_suffix('')}",
        )


def bag_repair(path: Path) -> str:
    """Return the remedy for a ``.bag``, ``.mcap`` or ``.db3`` file, or the directory of a bag of ROS 2."""
    if path.suffix == ".bag":
        return f"record it again, or repair it: rosbag reindex {path}"
    for file in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        if file.suffix == ".mcap" and not _is_whole(file):
            new = file.with_name(f"{file.stem}-repaired.mcap")
            return f"record it again, or, if its recorder was killed: mcap recover {file} -o {new}"
    return f"record it again, or repair it: ros2 bag reindex {path.parent if path.is_file() else path}"


def _is_whole(file: Path) -> bool:
    try:
        with file.open("rb") as content:
            content.seek(-len(MCAP_END), 2)
            return content.read() == MCAP_END
    except OSError:
        return False
