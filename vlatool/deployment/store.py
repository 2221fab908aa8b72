"""A store: two slots with a bundle each, and the pointer to the active one.

Whatever happens at any instant, the slot that the pointer names is whole: a slot is emptied only after the pointer has
stopped naming it, and named again only after all of it is on the disk and was read back from there.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from vlatool.bundle.bundle import DIGEST, MANIFEST, Bundle, digest_of, manifest_bytes
from vlatool.deployment.pointer import FILES, NAMES, Pointer, Slot, Trial, read_pointer, write_pointer
from vlatool.errors import BundleError, DeploymentError, OutputError
from vlatool.files.durable import remove_tree, sync_folder, sync_tree, write_file
from vlatool.files.verified_read import open_inside
from vlatool.runtime.arguments import check_path

MAX_STARTS = 3
"""Starts of a trial that did not end in an orderly way, after which it is rolled back: a loop of crashes."""
LOCK_S = 10.0
"""Seconds for which a controller waits for another process that changes the pointer."""
BLOCK = 1 << 20
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
MOUNT_NAMES = ("lost+found",)
"""What a file system has in its root: a store may be a partition of its own."""
VARIABLE = "VLATOOL_STORE"


def default_store() -> Path:
    """Return the store where none is named: ``$VLATOOL_STORE``, or ``vlatool/store`` in the user's data directory."""
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    return Path(os.environ.get(VARIABLE) or Path(data) / "vlatool/store")


class Store:
    """A directory with two slots and a pointer.

    Raises:
        UsageError: when the path is none.

    Example:
        >>> Store("/var/lib/robot/policy").read().active     # doctest: +SKIP
        'a'
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        check_path(path, "store")
        self.path = Path(path)

    def read(self) -> Pointer:
        """Return the pointer; an empty one where there is no store.

        Raises:
            DeploymentError: when it cannot be read.
        """
        return read_pointer(self.path)

    def read_deployed(self) -> Pointer:
        """Return the pointer of a store that holds a bundle; raises DeploymentError where it holds none."""
        pointer = self.read()
        if pointer.current is None:
            fix = "deploy one: vlatool deploy BUNDLE --store DIR"
            raise DeploymentError(f"The store {self.path} holds no bundle.", fix)
        return pointer

    def folder(self, name: str) -> Path:
        """Return the directory of a slot."""
        return self.path / name

    @contextlib.contextmanager
    def lock(self, wait_s: float = 0.0) -> Iterator[Pointer]:
        """Hold the store for one change at a time, and yield its pointer.

        Raises:
            DeploymentError: when another process holds it for longer than ``wait_s``, or the pointer cannot be read.
            OutputError: when it cannot be written.
        """
        with _write_errors(self.path):
            handle = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                _acquire(handle, self.path, wait_s)
                yield self.read()
            finally:
                os.close(handle)

    def make(self) -> None:
        """Make the directory of the store.

        Raises:
            DeploymentError: when it is there and holds something else: a bundle, a policy, files of a user.
            OutputError: when it cannot be made.
        """
        with _write_errors(self.path):
            self._refuse_other_files()
            missing = [parent for parent in (self.path, *self.path.parents) if not parent.exists()]
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            for folder in missing:
                sync_folder(folder.parent)

    def _refuse_other_files(self) -> None:
        """Refuse a directory with other files than an interrupted first deployment or a file system leaves there."""
        if self.path.exists() and not self.path.is_dir():
            raise DeploymentError(f"{self.path} is not a store: it is a file.", "name a directory: --store DIR")
        names = {entry.name for entry in self.path.iterdir()} if self.path.is_dir() else set()
        others = {name for name in names - {*NAMES, *MOUNT_NAMES} if not name.startswith(".")}
        if others and names.isdisjoint(FILES):
            found = ", ".join(sorted(others)[:6])
            raise DeploymentError(f"{self.path} is not a store: it holds other files (found: {found}).",
                                  "name an empty directory, or one that is not there yet: --store DIR")  # fmt: skip

    def write(self, pointer: Pointer) -> Pointer:
        """Replace the pointer at once, while ``lock`` is held; the directory is flushed when this returns."""
        return write_pointer(self.path, pointer)

    def fill(self, pointer: Pointer, bundle: Bundle) -> tuple[Pointer, Bundle]:
        """Copy a bundle into the slot that is not active, and return the pointer and the copy, verified from the disk.

        The pointer first stops naming the slot. Files of a bundle that a process still runs stay readable for it.

        Raises:
            BundleError: when the bundle changes meanwhile, or the copy is not what it should be.
            OSError: when it cannot be written.
        """
        if pointer.inactive in pointer.slots:
            pointer = self.write(pointer.without_inactive())
        slot = self.folder(pointer.inactive)
        remove_tree(slot)
        copy_bundle(bundle, slot)
        sync_folder(self.path)
        _forget_cache(slot, bundle)
        copy = Bundle.open(slot)
        if copy.hash != bundle.hash:
            raise BundleError(f"{slot} is not what was written: {copy.hash[:19]} instead of {bundle.hash[:19]}.")
        return pointer, copy

    def activate(self, pointer: Pointer, slot: Slot, trial: Trial | None) -> Pointer:
        """Make the slot that was filled the active one; the one before becomes what is gone back to."""
        slots = {**pointer.slots, pointer.inactive: slot}
        return self.write(replace(pointer, active=pointer.inactive, slots=slots, rollback="",
                                  trial=trial if pointer.slots else None))  # fmt: skip

    def roll_back(self, reason: str, bundle: str = "", wait_s: float = 0.0) -> Pointer:
        """Go back to the other slot, and return the pointer.

        Args:
            reason: reason, for ``vlatool status``.
            bundle: hash of the bundle to leave; nothing is done when another one is active. Any when empty.

        Raises:
            DeploymentError: when there is nothing to go back to, or as ``lock`` does.
        """
        return self._change(lambda pointer: self.pointer_after_rollback(pointer, reason), bundle, wait_s)

    def commit(self, bundle: str, wait_s: float = 0.0) -> Pointer:
        """End the trial of a bundle that has passed it, and return the pointer."""
        return self._change(lambda pointer: replace(pointer, trial=None), bundle, wait_s)

    def count_start(self, bundle: str, by: int, wait_s: float = 0.0) -> Pointer:
        """Count one start of the trial of a bundle more or less, and return the pointer."""
        return self._change(lambda pointer: _counted(pointer, by), bundle, wait_s)

    def _change(self, change: Callable[[Pointer], Pointer], bundle: str, wait_s: float) -> Pointer:
        with self.lock(wait_s) as pointer:
            if bundle and (pointer.current is None or pointer.current.bundle != bundle):
                return pointer
            changed = change(pointer)
            return pointer if changed == pointer else self.write(changed)

    def pointer_after_rollback(self, pointer: Pointer, reason: str) -> Pointer:
        """Return the pointer after a rollback; raises DeploymentError when there is nothing to go back to."""
        if pointer.inactive not in pointer.slots:
            raise DeploymentError(
                f"The store {self.path} holds no other bundle to go back to.", "deploy one: vlatool deploy BUNDLE"
            )
        return pointer.exchange(reason)


def copy_bundle(bundle: Bundle, folder: Path) -> None:
    """Copy the files that a bundle records into a new directory, and flush each file and directory.

    Raises:
        BundleError: when a file is missing, or not of the size in the manifest.
        OSError: when something cannot be written.
    """
    folder.mkdir(mode=0o700)
    for name, record in bundle.manifest.files.items():
        (folder / name).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_file(folder / name, _pieces(bundle.path, name, record.bytes))
    content = manifest_bytes(bundle.manifest)
    write_file(folder / MANIFEST, [content])
    write_file(folder / DIGEST, [digest_of(content)])
    sync_tree(folder)


def _pieces(root: Path, name: str, size: int) -> Iterator[bytes]:
    """Yield the content of a file of a bundle, no more than was recorded; the copy is verified later."""
    with open_inside(root, name) as handle:
        left = size
        while left and (piece := os.read(handle, min(left, BLOCK))):
            left -= len(piece)
            yield piece


def _forget_cache(folder: Path, bundle: Bundle) -> None:
    """Ask the kernel to drop the pages of files that were written: they are then read from the disk."""
    for name in bundle.manifest.files:
        handle = os.open(folder / name, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(handle)


def _counted(pointer: Pointer, by: int) -> Pointer:
    trial = pointer.trial
    return pointer if trial is None else replace(pointer, trial=replace(trial, starts=max(0, trial.starts + by)))


def _acquire(handle: int, path: Path, wait_s: float) -> None:
    until = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= until:
                raise DeploymentError(
                    f"Another process is changing the store {path}.", "wait until it is done"
                ) from None
            time.sleep(0.01)


@contextlib.contextmanager
def _write_errors(path: Path) -> Iterator[None]:
    """Raise OutputError or DeploymentError where the operating system refuses."""
    try:
        yield
    except FileNotFoundError as error:
        if error.filename == str(path):
            raise DeploymentError(
                f"There is no store at {path}.", "deploy a bundle into it: vlatool deploy BUNDLE --store DIR"
            ) from error
        raise OutputError(
            f"{error.filename} was removed meanwhile.", "let nothing else write into the store"
        ) from error
    except OSError as error:
        why = "its disk is full" if error.errno in NO_SPACE else str(error.strerror)
        raise OutputError(
            f"The store {path} cannot be changed: {why}.",
            "free some space, or name another directory with --store; vlatool status shows what is active",
        ) from error
