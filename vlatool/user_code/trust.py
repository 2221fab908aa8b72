"""Trust in code: only that of folders which the user named in this command, or trusted before, may run.

A bundle is data: nothing that its files say makes code run. What a stage needs of a policy's code is in the folder
that the bundle notes; it runs when the user named that folder (SOURCE, ``--policy``, ``--environment``), or trusted it
with ``--trust DIR``, as long as nothing in it has changed since.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import hash_file
from vlatool.errors import OutputError, SourceError, UsageError
from vlatool.files.messages import from_json, to_json

TRUST_VARIABLE = "VLATOOL_TRUST"
SCHEMA = 1
DATA_SUFFIXES = (".safetensors", ".npz", ".npy", ".onnx", ".png", ".jpg", ".mp4")
"""Endings of files that hold no code, whatever reads them."""
HISTORY = ".git"
CACHE = "__pycache__"
"""Where Python keeps ``module.TAG.pyc``: the policy's code is not read from there (``sources/_fresh.py``)."""
MAX_FILES = 20_000
NAME_SMALLER = "name a smaller directory"


@dataclass(frozen=True)
class NamedFolder:
    """A folder whose code may run.

    Args:
        folder: absolute, links resolved.
        description: its ``policy.yaml``, however it is called; empty for the usual name.
        factory: ``path.py:make`` where the user named one; empty for the one in the description.
        remembered: trusted before, by the hash of what is in the folder, and not named now.
    """

    folder: str
    description: str = ""
    factory: str = ""
    remembered: bool = False


_named: dict[str, NamedFolder] = {}


def allow(folder: Path, description: Path | None = None, factory: str = "") -> None:
    """Allow the code in a folder that the user named to run in this process."""
    where = str(folder.resolve())
    _named[where] = NamedFolder(where, str(description.resolve()) if description else "", factory)


def is_named(folder: Path) -> bool:
    """Say whether the user named a folder in this command."""
    return str(folder.resolve()) in _named


def named_folders() -> Any:
    """Return what was named, as JSON values for a child process."""
    return to_json([*_named.values()])


def restore(named: Any) -> None:
    """Take over the named folders of the parent process."""
    _named.clear()
    _named.update({each.folder: each for each in from_json(list[NamedFolder], named)})


@contextlib.contextmanager
def forget_named() -> Iterator[None]:
    """Begin a command: forget the folders that earlier commands of this process named."""
    before = named_folders()
    restore([])
    try:
        yield
    finally:
        restore(before)


def require(folder: Path, runs: str) -> NamedFolder:
    """Return how a folder was named.

    Args:
        folder: folder whose code would run.
        runs: what would run: ``make() of policy.py``.

    Raises:
        SourceError: when the folder was neither named nor trusted, or has changed since it was trusted.
    """
    where = str(folder.resolve())
    if where in _named:
        return _named[where]
    trusted = _read().get(where)
    if trusted is not None and trusted == content_hash(folder):
        return NamedFolder(where, remembered=True)
    why = "which you did not name" if trusted is None else "which has changed since you trusted it"
    raise SourceError(
        f"This would run {runs} in {where}, {why}.",
        f"look at what is in it; to allow it, run the command again with --trust {where}",
    )


def require_file(file: Path) -> None:
    """Check that a file which may hold code was trusted by name: nobody sees what is in it by looking at it.

    Raises:
        SourceError: when it was not, or has changed since.
    """
    where = str(file.resolve())
    trusted = _read().get(where)
    if trusted is None or trusted != hash_file(file):
        why = "which you did not trust" if trusted is None else "which has changed since you trusted it"
        raise SourceError(
            f"Opening {file} may run code that is in it, {why}.",
            f"if it comes from people whom you trust, run the command again with --trust {file}",
        )


def trust(folder: Path) -> None:
    """Remember that the code in a folder, or in one file, as it is now, may run.

    Raises:
        UsageError: when there is no such thing, or it has too many files.
        OutputError: when it cannot be remembered.
    """
    if not folder.is_dir() and not folder.is_file():
        raise UsageError(f"--trust {folder} is neither a directory nor a file.", "name the directory of a policy")
    content = hash_file(folder) if folder.is_file() else content_hash(folder)
    trusted = {**_read(), str(folder.resolve()): content}
    file = trust_file()
    draft = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as stream:
            json.dump({"schema": SCHEMA, "trusted": trusted}, stream, indent=1)
        draft.replace(file)
    except OSError as error:
        draft.unlink(missing_ok=True)
        fix = f"name another file: {TRUST_VARIABLE}=FILE"
        raise OutputError(f"{file} cannot be written: {error.strerror}.", fix) from error


def trust_file() -> Path:
    """Return the file of what is trusted: ``$VLATOOL_TRUST``, or ``vlatool/trusted.json`` among the user's settings."""
    if named := os.environ.get(TRUST_VARIABLE):
        return Path(named)
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "vlatool" / "trusted.json"


def content_hash(folder: Path) -> str:
    """Return the hash of all files of a folder that could hold code: names and bytes; links are followed.

    Raises:
        UsageError: when there are too many, or one cannot be read.
    """
    digest = hashlib.sha256()
    for count, (name, path) in enumerate(_files(folder)):
        if count >= MAX_FILES:
            raise UsageError(
                f"{folder} has more than {MAX_FILES:,} files, too many to trust.",
                f"{NAME_SMALLER}; installed packages (.venv, node_modules) and data belong elsewhere",
            )
        try:
            digest.update(json.dumps([name, hash_file(path) if isinstance(path, Path) else f"is {path}"]).encode())
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror}; it cannot be trusted.", NAME_SMALLER) from error
    return f"sha256:{digest.hexdigest()}"


def _files(folder: Path) -> Iterator[tuple[str, Path | str]]:
    """Yield name and path of each file; for a directory that was seen before, the name under which it was."""
    seen: dict[tuple[int, int], str] = {}

    def unreadable(error: OSError) -> None:
        raise UsageError(f"{error.filename} cannot be read: {error.strerror}; it cannot be trusted.", NAME_SMALLER)

    for root, folders, names in os.walk(folder, followlinks=True, onerror=unreadable):
        here = Path(root).relative_to(folder)
        about = os.stat(root)
        first = seen.setdefault((about.st_dev, about.st_ino), here.as_posix())
        if first != here.as_posix():
            folders[:] = []
            yield here.as_posix(), first
            continue
        folders[:] = sorted(set(folders) - {HISTORY})
        for name in sorted(names):
            path = Path(root, name)
            cached = here.name == CACHE and name.endswith(".pyc") and name.count(".") > 1
            if not cached and path.suffix not in DATA_SUFFIXES and path.is_file():
                yield (here / name).as_posix(), path


def _read() -> dict[str, str]:
    """Return folder -> content hash of what is trusted."""
    file = trust_file()
    try:
        with file.open(encoding="utf-8") as stream:
            about = os.fstat(stream.fileno())
            stored = json.load(stream)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise SourceError(f"{file} cannot be read: {error}.", "remove it, and trust again with --trust DIR") from error
    if about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise SourceError(f"{file} can be written by others.", f"remove it, or: chmod 600 {file}")
    trusted = stored.get("trusted") if isinstance(stored, dict) and stored.get("schema") == SCHEMA else None
    if not isinstance(trusted, dict) or not all(isinstance(digest, str) for digest in trusted.values()):
        raise SourceError(f"{file} is malformed.", "remove it, and trust again with --trust DIR")
    return trusted
