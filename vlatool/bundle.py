"""A bundle on disk: open, verify, hash."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vlatool.errors import BundleError
from vlatool.manifest import FileRecord, Manifest
from vlatool.written import LEDGER

MANIFEST = "manifest.json"
LOCATION = "location.json"
UNRECORDED = ("reports", "recipe.yaml", MANIFEST, "SIGNATURE", LOCATION, LEDGER)
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
