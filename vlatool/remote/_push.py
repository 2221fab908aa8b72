"""Upload to the target: vlatool's own files and those of the manifests, as a stream of small tar archives."""

from __future__ import annotations

import hashlib
import io
import os
import re
import tarfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vlatool.bundle.bundle import DIGEST, MANIFEST, Bundle, digest_of, manifest_bytes
from vlatool.deployment.signature import SIGNATURE
from vlatool.errors import BundleError, DataError
from vlatool.files.verified_read import COPY_AGAIN

PIECE = 8 << 20
"""Bytes of content in one tar: it is held in memory on both sides, so that nothing unverified is written."""
BLOCK = 4096


@dataclass(frozen=True)
class Item:
    """One file to push.

    Args:
        name: relative path on the target.
        size: size in bytes.
        path: the local file; None when ``content`` is it.
        content: the content of a file that is not read from ``path``.
        sha256: what the content must hash to; not checked when empty.
    """

    name: str
    size: int
    path: Path | None = None
    content: bytes = b""
    sha256: str = ""

    def pieces(self) -> Iterator[bytes]:
        """Yield the content in pieces."""
        if self.path is None:
            yield self.content
            return
        digest = hashlib.sha256()
        try:
            with self.path.open("rb") as stream:
                for start in range(0, max(self.size, 1), PIECE):
                    piece = stream.read(min(PIECE, self.size - start))
                    digest.update(piece)
                    yield piece
                longer = bool(stream.read(1))
        except OSError as error:
            raise BundleError(f"{self.path} cannot be read: {error.strerror}.", "copy or export it again") from error
        if longer or (self.sha256 and digest.hexdigest() != self.sha256):
            raise BundleError(f"{self.path} has changed: its SHA-256 is not the manifest's.", COPY_AGAIN)


@dataclass(frozen=True)
class Payload:
    """All that is pushed for one run; ``bundles`` are the directories on the target, in order."""

    items: tuple[Item, ...]
    bundles: tuple[str, ...]

    @property
    def size(self) -> int:
        """Content of all files in bytes."""
        return sum(item.size for item in self.items)

    @property
    def room(self) -> int:
        """Bytes that the files take on a disk, in whole blocks."""
        return sum(-(-item.size // BLOCK) * BLOCK + BLOCK for item in self.items)

    def archives(self) -> Iterator[tuple[bytes, int]]:
        """Yield tars and how many bytes of content each has; the same files give the same bytes."""
        pieces: list[tuple[str, bytes]] = []
        size = 0
        for item in self.items:
            for piece in item.pieces():
                if pieces and size + len(piece) > PIECE:
                    yield _tar(pieces), size
                    pieces, size = [], 0
                pieces.append((item.name, piece))
                size += len(piece)
        yield _tar(pieces), size


def payload_of(
    bundles: Sequence[Bundle], package: Path, further: Iterable[Path] = (), files: Mapping[str, Path] | None = None
) -> Payload:
    """Return what to push: each bundle once, by its content hash, after the package, single modules and other files."""
    items = {item.name: item for item in _package(package)}
    items |= {name: _file(name, path) for name, path in (files or {}).items()}
    items |= {f"package/{path.name}": Item(f"package/{path.name}", path.stat().st_size, path) for path in further}
    folders: dict[str, str] = {}
    for bundle in bundles:
        if bundle.hash not in folders:
            name = re.sub(r"[^\w.-]", "_", bundle.path.resolve().name, flags=re.ASCII).lstrip(".")[:80] or "bundle"
            folders[bundle.hash] = f"bundles/{bundle.hash.partition(':')[2][:16]}/{name}"
            items |= {item.name: item for item in _bundle(bundle, folders[bundle.hash])}
    return Payload(tuple(items.values()), tuple(folders[bundle.hash] for bundle in bundles))


def header(packed: bytes) -> dict[str, int | str]:
    """Return the message that goes before a tar: its size and SHA-256."""
    return {"bytes": len(packed), "sha256": hashlib.sha256(packed).hexdigest()}


def _package(package: Path) -> Iterator[Item]:
    """Yield the files of the installed package, without bytecode."""
    for path in sorted(package.rglob("*")):
        parts = path.relative_to(package.parent).parts
        if path.is_file() and not path.is_symlink() and path.suffix != ".pyc" and "__pycache__" not in parts:
            yield Item("/".join(("package", *parts)), path.stat().st_size, path)


def _bundle(bundle: Bundle, folder: str) -> Iterator[Item]:
    for name, record in bundle.manifest.files.items():
        path = bundle.path / name
        if path.is_symlink() or not path.is_file():
            raise BundleError(f"The bundle {bundle.path} lacks the file {name} (missing, or a link).", COPY_AGAIN)
        if path.stat().st_size != record.bytes:
            raise BundleError(f"{path} has {path.stat().st_size} bytes; the manifest says {record.bytes}.", COPY_AGAIN)
        yield Item(f"{folder}/{name}", record.bytes, path, sha256=record.sha256)
    if os.path.lexists(bundle.path / SIGNATURE):
        yield _file(f"{folder}/{SIGNATURE}", bundle.path / SIGNATURE)
    content = manifest_bytes(bundle.manifest)
    for name, text in ((MANIFEST, content), (DIGEST, digest_of(content))):
        yield Item(f"{folder}/{name}", len(text), content=text)


def _file(name: str, path: Path) -> Item:
    """Return a file that no manifest records."""
    if path.is_symlink() or not path.is_file():
        raise DataError(f"{path} is missing, or not a regular file.", "name a file")
    return Item(name, path.stat().st_size, path)


def _tar(pieces: Sequence[tuple[str, bytes]]) -> bytes:
    """Pack pieces of files: no owner, no time, no order but theirs."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as pack:
        for name, content in pieces:
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), 0o600
            pack.addfile(member, io.BytesIO(content))
    return packed.getvalue()
