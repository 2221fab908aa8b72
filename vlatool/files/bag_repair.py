"""What to do about a recorded bag that cannot be read: mostly its recorder was killed before it wrote the index."""

from __future__ import annotations

from pathlib import Path

MCAP_END = b"\x89MCAP0\r\n"
"""Last bytes of an mcap file that is whole (MCAP specification, "File structure")."""


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
