"""What a person names that may be a file or a directory of files, such as a recording: its files and its hash."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

from vlatool.errors import DataError
from vlatool.files.ownership import cached_hash
from vlatool.files.verified_read import DESKTOP_FILES


def files_below(path: Path) -> dict[str, Path]:
    """Return name relative to a directory -> file, in order; links to files count as files.

    Raises:
        DataError: for a link to a directory, and what is not a file.
    """
    files: dict[str, Path] = {}

    def unreadable(error: OSError) -> None:
        raise DataError(f"{error.filename} cannot be read: {error.strerror}.", "let this user read the directory")

    for root, folders, names in os.walk(path, onerror=unreadable):
        for entry in (Path(root, name) for name in (*folders, *names) if name not in DESKTOP_FILES):
            if entry.is_file():
                files[entry.relative_to(path).as_posix()] = entry
            elif entry.is_symlink() or not entry.is_dir():
                raise DataError(
                    f"{path} holds {entry.relative_to(path)}, which is not a file or a directory of files.",
                    "put a copy of what it stands for in its place",
                )
    return dict(sorted(files.items()))


def hash_directory(path: Path) -> str:
    """Return the SHA-256 of the names and contents of all files below a directory as hex.

    Raises:
        OSError: when a file cannot be read.
        DataError: as ``files_below``.
    """
    contents = [[name, cached_hash(file.resolve())] for name, file in files_below(path).items()]
    return hashlib.sha256(json.dumps(contents).encode()).hexdigest()
