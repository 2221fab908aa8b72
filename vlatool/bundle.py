"""A bundle on disk: open, verify, hash, and write so that a reader never sees half of one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.errors import BundleError, OutputError
from vlatool.manifest import FileRecord, Manifest

MANIFEST = "manifest.json"
LOCATION = "location.json"
OURS = (MANIFEST, "report.json", "policy.yaml")
"""Files that tell a directory which vlatool wrote from any other; only those are replaced by --force."""
UNRECORDED = ("reports", "recipe.yaml", MANIFEST, "SIGNATURE", LOCATION)
"""Names at the top of a bundle that the manifest holds no hash of: they are written about the bundle."""


@dataclass(frozen=True)
class Bundle:
    """A directory with a manifest whose files were verified when it was opened.

    Example:
        >>> bundle = Bundle.open(Path("out/vln-babyai"))     # doctest: +SKIP
        >>> bundle.manifest.spec.control_hz                  # doctest: +SKIP
        5
    """

    path: Path
    manifest: Manifest

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, verify: bool = True) -> Bundle:
        """Read the manifest and check size and SHA-256 of every file before anything else is parsed.

        Raises:
            BundleError: when the directory is missing, is no bundle, or a file is missing, changed or a link.
        """
        root = Path(path)
        manifest = Manifest.from_dict(_read_manifest(root))
        if verify:
            for name, record in manifest.files.items():
                _verify(root, name, record)
        return cls(root, manifest)

    @property
    def hash(self) -> str:
        """``sha256:...`` of the manifest, which in turn holds the hash of every file."""
        return "sha256:" + hashlib.sha256(manifest_bytes(self.manifest)).hexdigest()

    def file(self, name: str) -> Path:
        """Return the path of a recorded file.

        Raises:
            BundleError: when the manifest does not record it.
        """
        if name not in self.manifest.files:
            raise BundleError(f"The bundle {self.path} has no file '{name}'.")
        return self.path / name

    @property
    def size_bytes(self) -> int:
        """Sum of the sizes of all recorded files in bytes."""
        return sum(record.bytes for record in self.manifest.files.values())

    @property
    def graph_bytes(self) -> int:
        """Bytes of all graphs, with the weights that lie beside them, whatever their files are called."""
        graphs = tuple(graph.file for graph in self.manifest.graphs.values())
        folders = tuple(f"{folder}/" for graph in graphs if (folder := graph.rpartition("/")[0]))
        return sum(record.bytes for path, record in self.manifest.files.items() if path.startswith((*graphs, *folders)))


def seal(directory: Path, manifest: Manifest) -> Bundle:
    """Hash every file below ``directory``, write ``manifest.json`` last, and return the bundle."""
    files = {}
    for path in sorted(directory.rglob("*")):
        name = path.relative_to(directory).as_posix()
        if path.is_file() and name.partition("/")[0] not in UNRECORDED:
            files[name] = FileRecord(hash_file(path), path.stat().st_size)
    sealed = replace(manifest, files=files)
    (directory / MANIFEST).write_bytes(manifest_bytes(sealed))
    return Bundle(directory, sealed)


def restate(bundle: Bundle, manifest: Manifest) -> Bundle:
    """Write another manifest for a bundle whose files stay as they are, and return it."""
    (bundle.path / MANIFEST).write_bytes(manifest_bytes(manifest))
    return Bundle(bundle.path, manifest)


def manifest_bytes(manifest: Manifest) -> bytes:
    """Return the one way in which a manifest is written."""
    return (json.dumps(manifest.to_dict(), indent=1, ensure_ascii=False) + "\n").encode()


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file as hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest() if hasattr(hashlib, "file_digest") else _digest(stream)


def _digest(stream: Any) -> str:
    """``hashlib.file_digest`` for Python 3.10."""
    digest = hashlib.sha256()
    while block := stream.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


def _read_manifest(root: Path) -> Any:
    if not root.exists():
        raise BundleError(f"There is no bundle at {root}.")
    path = root / MANIFEST
    if not path.is_file():
        found = ", ".join(sorted(entry.name for entry in root.iterdir())[:6]) if root.is_dir() else "a file"
        raise BundleError(
            f"{root} is not a bundle: it has no {MANIFEST} (found: {found or 'nothing'}).",
            "make one with: vlatool export SOURCE -o BUNDLE",
        )
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise BundleError(f"{path} is not valid JSON: {error}.", "export the policy again") from error
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error.strerror}.") from error


def _verify(root: Path, name: str, record: FileRecord) -> None:
    path = root / name
    fix = "copy or export the bundle again"
    if path.is_symlink() or not path.is_file():
        raise BundleError(f"The bundle {root} lacks the file {name} (missing, or a link).", fix)
    size = path.stat().st_size
    if size != record.bytes:
        raise BundleError(f"{path} has {size} bytes; the manifest says {record.bytes}.", fix)
    if hash_file(path) != record.sha256:
        raise BundleError(f"{path} has changed: its SHA-256 is not the manifest's.", fix)


@contextlib.contextmanager
def writing(final: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a fresh directory beside ``final`` that becomes ``final`` when the block ends well.

    Everything is flushed to disk before the rename, so that a reader sees what was there before, nothing, or the whole
    new directory. What a killed writer left behind is removed by the next one.

    Raises:
        OutputError: when ``final`` exists (and not ``force``), or the place is read-only or full.
    """
    final = Path(os.path.abspath(final))
    with _output_errors(final):
        if os.path.exists(final) and not force:
            raise OutputError(f"{final} exists already.", "choose another output, or pass --force to replace it")
        final.parent.mkdir(parents=True, exist_ok=True)
        sweep(final)
        draft = final.with_name(f".{final.name}.tmp-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        draft.mkdir()
    lock = os.open(draft, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with _output_errors(final):
            yield draft
            _flush(draft)
            _move(draft, final)
    finally:
        os.close(lock)
        shutil.rmtree(draft, ignore_errors=True)


def sweep(final: Path) -> None:
    """Remove drafts of ``final`` whose writer is gone."""
    name = glob.escape(final.name)
    for stale in final.parent.glob(f".{name}.tmp-*"):
        if not _is_alive(stale):
            shutil.rmtree(stale, ignore_errors=True)
    for stale in final.parent.glob(f".{name}.old-*"):
        if final.exists():
            shutil.rmtree(stale, ignore_errors=True)


def _is_alive(draft: Path) -> bool:
    """A draft is alive while its process exists here or anybody holds its lock."""
    pid = draft.name.rpartition(".tmp-")[2].partition("-")[0]
    if pid.isdigit() and int(pid) != os.getpid() and Path(f"/proc/{pid}").exists():
        return True
    try:
        handle = os.open(draft, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(handle)
    return False


def _flush(directory: Path) -> None:
    for path in [*directory.rglob("*"), directory]:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _move(draft: Path, final: Path) -> None:
    old = final.with_name(f".{final.name}.old-{uuid.uuid4().hex[:8]}")
    if final.exists():
        os.rename(final, old)
    os.rename(draft, final)
    handle = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
    if old.is_dir():
        shutil.rmtree(old, ignore_errors=True)
    else:
        old.unlink(missing_ok=True)


@contextlib.contextmanager
def _output_errors(final: Path) -> Iterator[None]:
    """Map the operating system's refusals to write into one sentence for the person."""
    try:
        yield
    except OSError as error:
        reason = {
            errno.ENOSPC: ("the disk is full", "free some space, or write elsewhere"),
            errno.EDQUOT: ("the disk quota is used up", "free some space, or write elsewhere"),
            errno.EROFS: ("the file system is read-only", "write elsewhere"),
            errno.EACCES: ("permission denied", "write elsewhere, or change the permissions of the directory"),
            errno.EFBIG: ("a file would be larger than the limit on file sizes", "raise the limit (ulimit -f)"),
            errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
            errno.EEXIST: ("a part of the path is a file", "choose another output"),
            errno.ENOTDIR: ("a part of the path is a file", "choose another output"),
        }.get(error.errno or 0)
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        named = Path(str(error.filename or "-"))
        drafts = any(part.startswith(f".{final.name}.") for part in named.parts)
        ours = drafts or named.is_relative_to(final) or final.is_relative_to(named)
        if reason is None or not (full or ours):
            raise
        raise OutputError(f"Cannot write {final}: {reason[0]}.", reason[1]) from error
