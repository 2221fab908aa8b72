"""Signatures of bundles: Ed25519 over the hash of the manifest, which covers every file, and a release number.

The file ``SIGNATURE`` stands beside the manifest. Its release number is part of what is signed: who replays an older
bundle with its own valid signature is found out by it.
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import OutputError, SignatureError, require
from vlatool.files.durable import replace_file, sync_folder, write_file
from vlatool.files.json import parse_json
from vlatool.files.messages import from_json, to_json
from vlatool.files.ownership import add_to_ledger
from vlatool.files.verified_read import open_regular, read_all

SIGNATURE = "SIGNATURE"
SCHEMA = 1
MAX_BYTES = 1 << 12
MAX_KEY_BYTES = 1 << 14
MAX_RELEASE = 2**53
DOMAIN = "vlatool bundle signature 1"
"""First line of what is signed, so that a signature of something else never counts here."""
PUBLIC_SUFFIX = ".pub"
EXTRA = "sign"
SIGN_AGAIN = "sign the bundle again: vlatool sign BUNDLE --key KEY"
NEW_KEY = "make one: vlatool sign --new-key KEY"


@dataclass(frozen=True)
class Signature:
    """Content of ``SIGNATURE``.

    Args:
        bundle: ``sha256:...`` of the bundle.
        release: number that grows with each release.
        key: public key, 32 bytes as hex.
        signature: Ed25519 signature (RFC 8032), 64 bytes as hex.
    """

    bundle: str
    release: int
    key: str
    signature: str
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if self.schema != SCHEMA or not 1 <= self.release < MAX_RELEASE:
            raise ValueError("its schema or its release is unknown")
        for name, size in (("key", 64), ("signature", 128)):
            if not re.fullmatch(f"[0-9a-f]{{{size}}}", getattr(self, name)):
                raise ValueError(f"its {name} is not {size} hex digits")

    def encode(self) -> bytes:
        """Return the only valid content of the file."""
        return (json.dumps(to_json(self), indent=1) + "\n").encode()


def signed_bytes(bundle: str, release: int) -> bytes:
    """Return what is signed."""
    return f"{DOMAIN}\n{bundle}\n{release}\n".encode()


def new_key(path: Path) -> Path:
    """Write a private key, which only this user can read (0600), and its public key beside it; return the path of that.

    Raises:
        OutputError: when one of the files exists or cannot be written.
        MissingExtra: without ``cryptography``.
    """
    if not path.name:
        raise OutputError(f"'{path}' is not the name of a file.", "name one: vlatool sign --new-key KEY")
    private = _ed25519().Ed25519PrivateKey.generate()
    text = _serialization()
    public = path.with_name(path.name + PUBLIC_SUFFIX)
    for taken in (path, public):
        if os.path.lexists(taken):
            raise OutputError(f"{taken} exists already; a key is never replaced.", "choose another name")
    pem = text.Encoding.PEM
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, [private.private_bytes(pem, text.PrivateFormat.PKCS8, text.NoEncryption())])
        write_file(public, [private.public_key().public_bytes(pem, text.PublicFormat.SubjectPublicKeyInfo)])
        public.chmod(0o644)
        sync_folder(path.parent)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}.", "choose another directory") from error
    return public


def sign(bundle: Bundle, key: Path, release: int) -> Signature:
    """Sign a verified bundle and write ``SIGNATURE`` into it.

    Args:
        key: file of the private key.
        release: number that is higher than that of every earlier release.

    Raises:
        SignatureError: when the key cannot be read, is not an Ed25519 key, or others can read it.
        OutputError: when the signature cannot be written.
        MissingExtra: without ``cryptography``.
    """
    private = private_key(key)
    if not isinstance(private, _ed25519().Ed25519PrivateKey):
        raise SignatureError(f"{key} is a private key, but not of Ed25519.", NEW_KEY)
    text = _serialization()
    public = private.public_key().public_bytes(text.Encoding.Raw, text.PublicFormat.Raw).hex()
    signature = Signature(bundle.hash, release, public, private.sign(signed_bytes(bundle.hash, release)).hex())
    try:
        replace_file(bundle.path / SIGNATURE, signature.encode())
        add_to_ledger(bundle.path / SIGNATURE)
    except OSError as error:
        raise OutputError(
            f"{bundle.path} cannot be written: {error.strerror}.", "copy the bundle, and sign the copy"
        ) from error
    return signature


def verify(bundle: Bundle, keys: Iterable[str]) -> Signature:
    """Return the signature of a bundle if one of the keys made it.

    Args:
        bundle: bundle whose files were verified.
        keys: public keys as hex, see ``public_key``.

    Raises:
        SignatureError: when it is missing, damaged, of another bundle, or of another key.
        MissingExtra: without ``cryptography``.
    """
    signature = read_signature(bundle)
    where = f"The signature of {bundle.path}"
    if signature.bundle != bundle.hash:
        raise SignatureError(f"{where} is of another bundle ({signature.bundle[:19]}).", SIGN_AGAIN)
    if signature.key not in set(keys):
        raise SignatureError(
            f"{where} is of the key {signature.key[:16]}, which is not trusted here.",
            "sign the bundle with a key that is trusted, or verify it with the public key of its author",
        )
    invalid = require("cryptography.exceptions", EXTRA).InvalidSignature
    try:
        public = _ed25519().Ed25519PublicKey.from_public_bytes(bytes.fromhex(signature.key))
        public.verify(bytes.fromhex(signature.signature), signed_bytes(signature.bundle, signature.release))
    except (invalid, ValueError) as error:
        raise SignatureError(f"{where} is wrong: its key did not sign this.", SIGN_AGAIN) from error
    return signature


def read_signature(bundle: Bundle) -> Signature:
    """Return what ``SIGNATURE`` says, unverified; raises SignatureError when it is missing or damaged."""
    where = f"The signature of {bundle.path}"
    try:
        with open_regular(bundle.path, SIGNATURE) as handle:
            content = read_all(handle, MAX_BYTES)
    except FileNotFoundError:
        raise SignatureError(f"{bundle.path} has no signature.", SIGN_AGAIN) from None
    except OSError as error:
        raise SignatureError(f"{where} cannot be read: {error.strerror}.", SIGN_AGAIN) from error
    return decode(content, where)


def decode(content: bytes, where: str) -> Signature:
    """Return the signature in a content; raises SignatureError for one that ``Signature.encode`` does not write."""
    try:
        if len(content) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES} bytes")
        signature = from_json(Signature, parse_json(content, strict=True), "signature")
        if signature.encode() != content:
            raise ValueError("it was changed")
    except ValueError as error:
        raise SignatureError(f"{where} is damaged: {str(error)[:200]}.", SIGN_AGAIN) from error
    return signature


def public_key(path: Path) -> str:
    """Return the public key in a PEM file as hex; raises SignatureError when it is not one."""
    text = _serialization()
    try:
        key = text.load_pem_public_key(_key_bytes(path))
    except SignatureError:
        raise
    except Exception as error:  # the library has many classes of errors for what is not a key
        raise SignatureError(
            f"{path} is not a public key in PEM.", f"name the file KEY{PUBLIC_SUFFIX}; or {NEW_KEY}"
        ) from error
    if not isinstance(key, _ed25519().Ed25519PublicKey):
        raise SignatureError(f"{path} is a public key, but not of Ed25519.", NEW_KEY)
    return str(key.public_bytes(text.Encoding.Raw, text.PublicFormat.Raw).hex())


def private_key(path: Path, fix: str = NEW_KEY) -> Any:
    """Return the private key in a PEM file, of whatever kind.

    Args:
        path: its file, which nobody else can read.
        fix: what to do when it is not one.

    Raises:
        SignatureError: when it cannot be read, is not a private key, has a passphrase, or others can read it.
        MissingExtra: without ``cryptography``.
    """
    text, content = _serialization(), _key_bytes(path, private=True)
    try:
        return text.load_pem_private_key(content, None)
    except Exception as error:
        raise SignatureError(f"{path} is not a private key in PEM without a passphrase.", fix) from error


def _key_bytes(path: Path, *, private: bool = False) -> bytes:
    try:
        with open_regular(path.resolve().parent, path.resolve().name) as handle:
            if private and stat.S_IMODE(os.fstat(handle).st_mode) & 0o077:
                raise SignatureError(
                    f"Others can read the private key {path}.", f"chmod 600 {path}; better, make a new one"
                )
            content = read_all(handle, MAX_KEY_BYTES)
    except OSError as error:
        raise SignatureError(f"The key {path} cannot be read: {error.strerror}.", NEW_KEY) from error
    if len(content) > MAX_KEY_BYTES:
        raise SignatureError(f"{path} is too large for a key.", NEW_KEY)
    return content


def _ed25519() -> Any:
    return require("cryptography.hazmat.primitives.asymmetric.ed25519", EXTRA)


def _serialization() -> Any:
    return require("cryptography.hazmat.primitives.serialization", EXTRA)
