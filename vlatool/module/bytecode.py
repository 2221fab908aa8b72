"""A policy's code is always compiled from source: bytecode in ``__pycache__`` is not hashed and could do anything."""

from __future__ import annotations

import os
import site
import sys
import sysconfig
from functools import lru_cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

from vlatool.user_code import trust

VARIABLE = "PYTHONPYCACHEPREFIX"
_folders: dict[str, bool] = {}
"""Folder -> whether it was trusted before: then the targets of its links are not cached either."""
_original_get_code = SourceFileLoader.get_code


def ignore_bytecode(folder: Path) -> None:
    """Keep this process from reading ``__pycache__`` below a policy's folder, however its files are imported.

    Where the folder was trusted before, everything outside of Python's own directories is compiled afresh, and
    Python processes that the policy starts read no such directory at all.
    """
    remembered = not trust.is_named(folder)
    _folders[str(folder.resolve())] = remembered
    if remembered:
        os.environ[VARIABLE] = os.devnull  # below it is nothing, and nothing can be put there
    SourceFileLoader.get_code = _get_code  # type: ignore[method-assign, assignment]


def _get_code(self: SourceFileLoader, fullname: str) -> CodeType | None:
    path = self.get_filename(fullname)
    if not _is_own(os.path.dirname(path)):
        return _original_get_code(self, fullname)
    return self.source_to_code(self.get_data(path), path)


def _is_own(directory: str) -> bool:
    """Return whether a directory holds a policy's code, and not what is installed."""
    paths = {os.path.abspath(directory), os.path.realpath(directory)}
    inside = {remembered for folder, remembered in _folders.items() if any(_is_below(path, folder) for path in paths)}
    library = any(_is_below(os.path.realpath(directory), folder) for folder in _libraries())
    return True in inside or (not library and (bool(inside) or any(_folders.values())))


def _is_below(directory: str, folder: str) -> bool:
    return directory == folder or directory.startswith(folder.rstrip(os.sep) + os.sep)


@lru_cache(1)
def _libraries() -> tuple[str, ...]:
    """Python's own directories, those of installed packages, and this package."""
    folders = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    folders += [*site.getsitepackages(), site.getusersitepackages(), str(Path(__file__).parents[1])]
    folders += [entry for entry in sys.path if Path(entry).name in ("site-packages", "dist-packages")]
    return tuple({os.path.realpath(entry) for entry in folders})
