"""A private directory on the target for one run, which is removed afterwards: used by ``_bootstrap`` there."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import signal
import tempfile
import time
from pathlib import Path

BLOCK = 4096
PREFIX = "vlatool-run-"
LOCK = "lock"
CREATED_FILE = "made"
"""File that names the directories which the first run made; the last run removes them."""


class Refused(Exception):
    """Something that the other side must be told: a word for it, and what it was."""

    def __init__(self, word: str, text: str = "") -> None:
        super().__init__(word, text)
        self.word = word
        self.text = text


class RunDirectory:
    """A private directory with a lock that is held as long as its run lives."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._shared: Path | None = None

    @property
    def path(self) -> Path:
        """Path of the directory, while it exists."""
        if self._path is None:
            raise Refused("no place", "the directory of the run is gone")
        return self._path

    def make(self) -> None:
        """Make it in the user's cache directory, or where temporary files go."""
        refusals = []
        for attempt in (self._cache, self._cache, self._cache, self._temporary):
            try:
                self._path = attempt()
                if self._lockable(self._path):
                    return
            except OSError as error:
                refusals.append(f"{error.filename}: {error.strerror}")
                self.remove()
        raise Refused("no place", "; ".join(dict.fromkeys(refusals)))

    def _cache(self) -> Path:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        self._shared = cache / "vlatool" / "remote"
        missing = [str(parent) for parent in (cache, *cache.parents) if not parent.exists()]
        self._shared.mkdir(mode=0o700, parents=True, exist_ok=True)
        if missing:
            (self._shared / CREATED_FILE).write_text("\0".join(missing), encoding="utf-8", errors="surrogateescape")
        sweep(self._shared)
        return Path(tempfile.mkdtemp(prefix=PREFIX, dir=self._shared))

    def _temporary(self) -> Path:
        self._shared = None
        folder = Path(os.environ.get("TMPDIR") or "/tmp")
        sweep(folder)
        return Path(tempfile.mkdtemp(prefix=PREFIX, dir=folder))

    def _lockable(self, path: Path) -> bool:
        """Take the lock, unless another run took the new directory for one of a dead run."""
        try:
            handle = os.open(path / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
            with contextlib.suppress(OSError):  # a file system without locks: nobody sweeps there either
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return os.path.samestat(os.stat(path / LOCK), os.fstat(handle))
        except FileNotFoundError:
            return False

    def room(self) -> int:
        """Return how many bytes are free."""
        disk = os.statvfs(self.path)
        return disk.f_bavail * disk.f_frsize

    def remove(self) -> str:
        """Remove the directory and the parents that are empty and vlatool's, and return what is left."""
        path, self._path = self._path, None
        for _ in range(20):
            if path is None or not path.exists():
                break
            shutil.rmtree(path, ignore_errors=True)
            time.sleep(0.05 * path.exists())
        self._remove_parents()
        return str(path) if path and path.exists() else ""

    def _remove_parents(self) -> None:
        """Remove the directories that runs made, when this is the last run in them; vlatool's own when empty."""
        if self._shared is None:
            return
        with contextlib.suppress(OSError):
            record = self._shared / CREATED_FILE
            left = os.listdir(self._shared)
            parents = [self._shared, self._shared.parent]
            if left == [CREATED_FILE]:
                parents += map(Path, record.read_text(encoding="utf-8", errors="surrogateescape").split("\0"))
                record.unlink()
            for parent in parents:
                parent.rmdir()


def sweep(folder: Path) -> None:
    """Remove directories of runs that are dead: nobody holds their lock."""
    for stale in folder.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            if stale.is_symlink() or not stale.is_dir() or stale.stat().st_uid != os.getuid():
                continue
            handle = os.open(stale / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(stale, ignore_errors=True)
            finally:
                os.close(handle)


class Guard:
    """A process that outlives this one when it is killed, ends the agent and removes the directory."""

    def __init__(self, directory: RunDirectory) -> None:
        waits, self._tells = os.pipe()
        self._process = os.fork()
        if self._process == 0:
            os.close(self._tells)
            with contextlib.suppress(BaseException):
                _guard(waits, directory)
            os._exit(0)
        os.close(waits)

    def watch(self, group: int) -> None:
        """Name the process group of the agent."""
        os.write(self._tells, f"{group}\n".encode())

    def dismiss(self) -> None:
        """Let the guard go: all is removed."""
        with contextlib.suppress(OSError):
            os.write(self._tells, b"done\n")
            os.close(self._tells)
            os.waitpid(self._process, 0)


def _guard(waits: int, directory: RunDirectory) -> None:
    os.setsid()
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    nothing = os.open(os.devnull, os.O_RDWR)
    for handle in (0, 1, 2):
        os.dup2(nothing, handle)
    received = b""
    while block := os.read(waits, BLOCK):
        received += block
    words = received.decode().split()
    if "done" not in words:
        for word in words:
            kill(int(word))
        directory.remove()


def kill(group: int) -> None:
    """Kill a process group."""
    with contextlib.suppress(OSError):
        os.killpg(group, signal.SIGKILL)
