"""A bundle on disk: open, verify, hash."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlatool.bundle.manifest import FileRecord, Manifest, check_files
from vlatool.errors import BundleError
from vlatool.files import verified_read
from vlatool.files.json import read_json
from vlatool.files.limits import check_limit, limit
from vlatool.files.verified_read import COPY_AGAIN, DESKTOP_FILES, LEDGER

MANIFEST = "manifest.json"
DIGEST = "manifest.sha256"
"""The SHA-256 of the manifest, as ``sha256sum`` writes it: what protects everything that the manifest says."""
LOCATION = "location.json"
REPORTS = "reports"
UNRECORDED_NAMES = (REPORTS, "recipe.yaml", MANIFEST, DIGEST, "SIGNATURE", LOCATION, LEDGER)
"""Names at the top of a bundle that the manifest holds no hash of: they are written about the bundle."""
ASSETS = "assets"


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
    _verified: set[str] = field(default_factory=set, repr=False, compare=False)

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, verify: bool = True) -> Bundle:
        """Read the manifest, check it against its digest, and check every file before anything else is parsed.

        Args:
            verify: whether to check that the files are exactly those of the manifest, by size and SHA-256.

        Raises:
            BundleError: when the directory is missing or no bundle, or a file is missing, changed, unknown or a link.
            SpecError: for an impossible spec or program.
        """
        bundle = cls.open_lazily(path)
        if verify:
            bundle.verify()
        return bundle

    @classmethod
    def open_lazily(cls, path: str | os.PathLike[str]) -> Bundle:
        """Read the manifest, check it against its digest; the files are checked when they are read (``read``).

        Raises:
            BundleError: when the directory is missing or is not a bundle, or the manifest is changed or invalid.
            SpecError: for an impossible spec or program.
        """
        root = Path(path)
        bundle = cls(root, Manifest.from_dict(_read_manifest(root)))
        check_limit("bundle_bytes", bundle.size_bytes, f"{root}: what the manifest records", BundleError)
        return bundle

    def verify(self, prefix: str = "", but: str = "") -> None:
        """Check every file that was not verified by reading it, and that nothing else is there.

        Args:
            prefix: prefix of the names of the files whose content is checked.
            but: prefix of the names that are left out; none when empty.

        Raises:
            BundleError: when a file is missing, changed, a link, or not in the manifest.
        """
        self.check_tree()
        for name, record in self.manifest.files.items():
            if name.startswith(prefix) and not (but and name.startswith(but)) and name not in self._verified:
                verified_read.verify_file(self.path, name, record.sha256, record.bytes)

    def check_tree(self) -> None:
        """Refuse what the manifest does not record, and a manifest that names files which it does not record.

        Raises:
            BundleError: naming the first such file.
        """
        check_files(self.manifest)
        try:
            stranger = verified_read.find_unlisted(self.path, set(self.manifest.files), UNRECORDED_NAMES[1:], REPORTS)
        except OSError as error:
            raise BundleError(
                f"{self.path} cannot be read: {error.strerror}.",
                "let this user read the directory and all that is in it",
            ) from error
        if stranger and (self.path / stranger).is_symlink():
            raise BundleError(
                f"The bundle {self.path} holds {stranger}, which is a link; a bundle has none.", COPY_AGAIN
            )
        if stranger:
            raise BundleError(
                f"The bundle {self.path} holds {stranger}, which its manifest does not record.",
                f"remove it, or put it into {self.path / REPORTS}; or copy or export the bundle again",
            )

    def read(self, name: str, allowed: str = "") -> bytes:
        """Return the content of a recorded file: the very bytes that were verified, read once.

        Args:
            allowed: name of the limit on its size.

        Raises:
            BundleError: when the manifest does not record it, it is larger than the limit, or it is not what the
                manifest says.
        """
        sha256, size = self._record(name)
        if allowed:
            check_limit(allowed, size, f"{self.path / name}", BundleError)
        content = verified_read.read_verified(self.path, name, sha256, size)
        self._verified.add(name)
        return content

    def asset(self, name: str, allowed: str = "") -> bytes:
        """Return the content of a file of ``assets/``; see ``read``."""
        return self.read(f"{ASSETS}/{name}", allowed)

    @contextlib.contextmanager
    def verified_folder(self, folder: str, names: Iterable[str]) -> Iterator[Path]:
        """Verify files that an engine opens by name, and give the directory ``folder`` while they stay as they are.

        Raises:
            BundleError: when a file is not what the manifest says, or changed before the block ended.
        """
        files = {name: self._record(name) for name in names}
        with verified_read.verified_directory(self.path, folder, files) as path:
            yield path
        self._verified.update(files)

    def _record(self, name: str) -> tuple[str, int]:
        if name not in self.manifest.files:
            raise BundleError(f"The bundle {self.path} has no file '{name}'.")
        record = self.manifest.files[name]
        return record.sha256, record.bytes

    @property
    def hash(self) -> str:
        """``sha256:...`` of the manifest, which in turn holds the hash of every file."""
        return "sha256:" + hashlib.sha256(manifest_bytes(self.manifest)).hexdigest()

    def file(self, name: str) -> Path:
        """Return the path of a recorded file, to which no link leads.

        Raises:
            BundleError: when the manifest does not record it, or it or a directory above it is a link.
        """
        self._record(name)
        path = self.path
        for part in name.split("/"):
            path /= part
            if path.is_symlink():
                raise BundleError(f"The bundle {self.path} lacks the file {name} (missing, or a link).", COPY_AGAIN)
        return path

    @property
    def size_bytes(self) -> int:
        """Sum of the sizes of all recorded files in bytes."""
        return sum(record.bytes for record in self.manifest.files.values())

    @property
    def graph_bytes(self) -> int:
        """Bytes of all graphs, with the weights beside them, whatever their files are called."""
        graphs = tuple(graph.file for graph in self.manifest.graphs.values())
        folders = tuple(f"{folder}/" for graph in graphs if (folder := graph.rpartition("/")[0]))
        beside = () if len(folders) == len(graphs) else tuple(name for name in self.manifest.files if "/" not in name)
        prefixes = (*graphs, *folders, *beside)
        return sum(record.bytes for path, record in self.manifest.files.items() if path.startswith(prefixes))


def seal(directory: Path, manifest: Manifest) -> Bundle:
    """Hash every file below ``directory``, write ``manifest.json`` and its digest last, and return the bundle."""
    from vlatool.files.ownership import cached_hash  # a robot seals nothing

    files = {}
    for path in sorted(directory.rglob("*")):
        name = path.relative_to(directory).as_posix()
        if path.is_file() and name.partition("/")[0] not in UNRECORDED_NAMES and path.name not in DESKTOP_FILES:
            status = path.stat()
            linked = status.st_nlink > 1  # shared among stages of the cache, and read-only
            files[name] = FileRecord(cached_hash(path) if linked else hash_file(path), status.st_size)
    sealed = replace(manifest, files=files)
    write_manifest(directory, sealed)
    return Bundle(directory, sealed)


def replace_manifest(bundle: Bundle, manifest: Manifest) -> Bundle:
    """Write another manifest for a bundle whose files stay as they are, and return it."""
    write_manifest(bundle.path, manifest)
    return Bundle(bundle.path, manifest)


def write_manifest(directory: Path, manifest: Manifest) -> None:
    """Write ``manifest.json`` and ``manifest.sha256``."""
    content = manifest_bytes(manifest)
    (directory / MANIFEST).write_bytes(content)
    (directory / DIGEST).write_bytes(digest_of(content))


def manifest_bytes(manifest: Manifest) -> bytes:
    """Return the one way in which a manifest is written."""
    return (json.dumps(manifest.to_dict(), indent=1, ensure_ascii=False) + "\n").encode()


def digest_of(content: bytes) -> bytes:
    """Return what ``manifest.sha256`` says of a manifest: ``sha256sum -c manifest.sha256`` reads it, too."""
    return f"{hashlib.sha256(content).hexdigest()}  {MANIFEST}\n".encode()


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file as hex."""
    with path.open("rb", buffering=0) as stream:
        return verified_read.hash_handle(stream.fileno())


def _read_manifest(root: Path) -> Any:
    if not root.exists():
        raise BundleError(f"No bundle at {root}.", "check the path; make one with: vlatool export SOURCE -o BUNDLE")
    path = root / MANIFEST
    if not path.is_file():
        entries = ", ".join(sorted(entry.name for entry in root.iterdir())[:6]) if root.is_dir() else "a file"
        raise BundleError(
            f"{root} is not a bundle: it has no {MANIFEST} (found: {entries or 'nothing'}).",
            "make one with: vlatool export SOURCE -o BUNDLE",
        )
    content = _read_small(root, MANIFEST, limit("manifest_bytes"))
    check_limit("manifest_bytes", len(content), f"{path}", BundleError)
    _check_digest(root, content)
    return read_json(content, f"{path}", BundleError, "export the policy again", strict=True)


def _check_digest(root: Path, content: bytes) -> None:
    if not (root / DIGEST).exists():
        raise BundleError(
            f"{root} has no {DIGEST}: an older vlatool made it, or the file was removed.",
            f"export the policy again; or, if you trust this copy: cd {root} && sha256sum {MANIFEST} > {DIGEST}",
        )
    if _read_small(root, DIGEST, 4096) != digest_of(content):
        raise BundleError(f"{root / MANIFEST} has changed: its SHA-256 is not what {DIGEST} says.", COPY_AGAIN)


def _read_small(root: Path, name: str, most: int) -> bytes:
    """Return the content of a file that is not recorded: up to ``most`` bytes, and one more when it has more."""
    with verified_read.open_inside(root, name) as handle:
        return verified_read.read_all(handle, min(os.fstat(handle).st_size, most))
