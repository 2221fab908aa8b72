"""OpenSSF signatures: what the format says, checked without the code that writes it."""

import base64
import hashlib
import json
import shutil

import pytest
from _slots import bundle_of
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa, x25519

from vlatool.bundle.bundle import Bundle
from vlatool.deployment import openssf, signature
from vlatool.errors import OutputError, SignatureError

CURVES = {"P-256": (ec.SECP256R1, hashes.SHA256), "P-384": (ec.SECP384R1, hashes.SHA384),
          "P-521": (ec.SECP521R1, hashes.SHA512)}  # fmt: skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Bundle:
    return bundle_of(tmp_path_factory.mktemp("plain") / "bundle", 1)


def write_key(path, private):
    text = serialization
    path.write_bytes(private.private_bytes(text.Encoding.PEM, text.PrivateFormat.PKCS8, text.NoEncryption()))
    path.chmod(0o600)
    return path


def read(path) -> tuple[dict, bytes, bytes]:
    content = json.loads(path.read_text())
    envelope = content["dsseEnvelope"]
    assert content["mediaType"] == "application/vnd.dev.sigstore.bundle.v0.3+json"
    assert envelope["payloadType"] == "application/vnd.in-toto+json"
    return content, base64.b64decode(envelope["payload"]), base64.b64decode(envelope["signatures"][0]["sig"])


@pytest.mark.parametrize("name", CURVES)
def test_the_envelope_is_signed_and_lists_each_file(plain, tmp_path, name):
    curve, digest = CURVES[name]
    private = ec.generate_private_key(curve())
    openssf.sign(plain, write_key(tmp_path / "key", private), tmp_path / "model.sig")
    content, payload, signed = read(tmp_path / "model.sig")
    pae = b"DSSEv1 28 application/vnd.in-toto+json %d %s" % (len(payload), payload)
    private.public_key().verify(signed, pae, ec.ECDSA(digest()))
    with pytest.raises(InvalidSignature):
        private.public_key().verify(signed, pae + b" ", ec.ECDSA(digest()))
    pem = private.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    assert content["verificationMaterial"]["publicKey"]["hint"] == hashlib.sha256(pem).hexdigest()

    statement = json.loads(payload)
    there = {path.relative_to(plain.path).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
             for path in plain.path.rglob("*") if path.is_file()}  # fmt: skip
    resources = statement["predicate"]["resources"]
    ignored = set(statement["predicate"]["serialization"]["ignore_paths"])
    there = {file: value for file, value in there.items() if file.partition("/")[0] not in ignored}
    assert {each["name"]: each["digest"] for each in resources} == there
    assert [each["name"] for each in resources] == sorted(there)
    root = hashlib.sha256(b"".join(bytes.fromhex(each["digest"]) for each in resources)).hexdigest()
    assert statement["subject"] == [{"name": plain.path.name, "digest": {"sha256": root}}]


def test_other_keys_are_refused(plain, tmp_path):
    keys = [ec.generate_private_key(ec.SECP256K1()), rsa.generate_private_key(65537, 2048),
            x25519.X25519PrivateKey.generate()]  # fmt: skip
    for number, private in enumerate(keys):
        with pytest.raises(SignatureError, match="not an ECDSA key"):
            openssf.sign(plain, write_key(tmp_path / f"{number}", private), tmp_path / "model.sig")
    signature.new_key(tmp_path / "own")
    with pytest.raises(SignatureError, match="not an ECDSA key"):
        openssf.sign(plain, tmp_path / "own", tmp_path / "model.sig")
    with pytest.raises(SignatureError, match="but not of Ed25519"):
        signature.sign(plain, write_key(tmp_path / "ec", ec.generate_private_key(ec.SECP256R1())), 1)
    (tmp_path / "ec").chmod(0o644)
    with pytest.raises(SignatureError, match="Others can read"):
        openssf.sign(plain, tmp_path / "ec", tmp_path / "model.sig")
    assert not (tmp_path / "model.sig").exists()


def test_it_is_written_beside_the_bundle(plain, tmp_path):
    bundle = Bundle.open(shutil.copytree(plain.path, tmp_path / "copy"))
    key = write_key(tmp_path / "key", ec.generate_private_key(ec.SECP256R1()))
    for inside in (bundle.path / "model.sig", bundle.path / "graphs/../x"):
        with pytest.raises(OutputError, match="inside of the bundle"):
            openssf.sign(bundle, key, inside)
    with pytest.raises(OutputError, match="cannot be written"):
        openssf.sign(bundle, key, tmp_path / "nowhere/model.sig")
    Bundle.open(bundle.path)
