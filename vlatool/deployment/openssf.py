"""Signatures in the format of OpenSSF Model Signing 1.0, for those who verify models with its tools.

A Sigstore bundle (0.3) with a DSSE envelope around an in-toto statement, which lists the SHA-256 of each file; see
https://github.com/sigstore/model-transparency. The robot does not read it: ``SIGNATURE`` also holds a release number.
"""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import DIGEST, MANIFEST, UNRECORDED_NAMES, Bundle
from vlatool.deployment.signature import EXTRA, private_key
from vlatool.errors import OutputError, SignatureError, require
from vlatool.files.durable import replace_file

PAYLOAD_TYPE = "application/vnd.in-toto+json"
STATEMENT_TYPE = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE = "https://model_signing/signature/v1.0"
MEDIA_TYPE = "application/vnd.dev.sigstore.bundle.v0.3+json"
CURVES = {"secp256r1": "SHA256", "secp384r1": "SHA384", "secp521r1": "SHA512"}
"""Curves that the format allows, with the hash of each."""
NEW_KEY = "make one: openssl ecparam -name prime256v1 -genkey -noout -out KEY; chmod 600 KEY"


def sign(bundle: Bundle, key: Path, output: Path) -> str:
    """Sign a verified bundle and write the signature to a file outside of it.

    Args:
        key: private key (PEM) on one of ``CURVES``.
        output: file to write or replace.

    Returns:
        SHA-256 of the public key in PEM as hex, by which the format names it.

    Raises:
        SignatureError: when the key cannot be read, others can read it, or it is not on one of the curves.
        OutputError: when the file is inside of the bundle or cannot be written.
        MissingExtra: without ``cryptography``.
    """
    if output.resolve().is_relative_to(bundle.path.resolve()):
        raise OutputError(f"{output} is inside of the bundle, which it would change.", "name a file beside it")
    private = private_key(key, NEW_KEY)
    curve = getattr(getattr(private, "curve", None), "name", "")
    if curve not in CURVES or not hasattr(private, "sign"):
        raise SignatureError(f"{key} is not an ECDSA key on {', '.join(CURVES)}.", NEW_KEY)
    hashes = require("cryptography.hazmat.primitives.hashes", EXTRA)
    ec = require("cryptography.hazmat.primitives.asymmetric.ec", EXTRA)
    payload = json.dumps(statement(bundle)).encode()
    signature = private.sign(pre_authentication(payload), ec.ECDSA(getattr(hashes, CURVES[curve])()))
    hint = _key_hash(private)
    content = {
        "mediaType": MEDIA_TYPE,
        "verificationMaterial": {"publicKey": {"hint": hint}, "tlogEntries": []},
        "dsseEnvelope": {
            "payload": base64.b64encode(payload).decode(),
            "payloadType": PAYLOAD_TYPE,
            "signatures": [{"sig": base64.b64encode(signature).decode(), "keyid": ""}],
        },
    }
    try:
        replace_file(output, (json.dumps(content) + "\n").encode())
    except OSError as error:
        raise OutputError(f"{output} cannot be written: {error.strerror}.", "choose another file") from error
    return hint


def statement(bundle: Bundle) -> dict[str, Any]:
    """Return the in-toto statement: each file that the manifest records, the manifest, and a hash over their hashes."""
    digests = {name: record.sha256 for name, record in bundle.manifest.files.items()}
    for name in (MANIFEST, DIGEST):
        digests[name] = hashlib.sha256((bundle.path / name).read_bytes()).hexdigest()
    names = sorted(digests)
    root = hashlib.sha256(b"".join(bytes.fromhex(digests[name]) for name in names)).hexdigest()
    left_out = sorted(set(UNRECORDED_NAMES) - {MANIFEST, DIGEST})
    return {
        "_type": STATEMENT_TYPE,
        "subject": [{"name": bundle.path.resolve().name, "digest": {"sha256": root}}],
        "predicateType": PREDICATE_TYPE,
        "predicate": {
            "serialization": {
                "method": "files",
                "hash_type": "sha256",
                "allow_symlinks": False,
                "ignore_paths": left_out,
            },
            "resources": [{"name": name, "algorithm": "sha256", "digest": digests[name]} for name in names],
        },
    }


def pre_authentication(payload: bytes) -> bytes:
    """Return what DSSE signs: PAE of type and payload (https://github.com/secure-systems-lab/dsse, protocol 1.0)."""
    return f"DSSEv1 {len(PAYLOAD_TYPE)} {PAYLOAD_TYPE} {len(payload)} ".encode() + payload


def _key_hash(private: Any) -> str:
    text = require("cryptography.hazmat.primitives.serialization", EXTRA)
    public = private.public_key().public_bytes(text.Encoding.PEM, text.PublicFormat.SubjectPublicKeyInfo)
    return hashlib.sha256(public).hexdigest()
