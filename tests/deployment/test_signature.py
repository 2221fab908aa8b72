"""Signatures: what was signed is accepted, and each change, other key and other bundle is refused by name."""

import json
import shutil
import stat
import sys
from pathlib import Path

import pytest
from _slots import bundle_of

from vlatool.bundle.bundle import Bundle
from vlatool.deployment import signature
from vlatool.deployment.signature import SIGNATURE, new_key, public_key, sign, verify
from vlatool.errors import BundleError, MissingExtra, OutputError, SignatureError
from vlatool.files.directory_writer import write_directory


@pytest.fixture(scope="module")
def keys(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("keys")
    new_key(folder / "one")
    new_key(folder / "other")
    return [folder / "one", folder / "other"]


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Bundle:
    return bundle_of(tmp_path_factory.mktemp("plain") / "bundle", 1)


@pytest.fixture
def bundle(plain, tmp_path) -> Bundle:
    return Bundle.open(shutil.copytree(plain.path, tmp_path / "copy"))


def public(path: Path) -> str:
    return public_key(path.with_name(path.name + ".pub"))


def test_a_signature_is_verified_beside_its_manifest(bundle, keys):
    made = sign(bundle, keys[0], 7)
    assert verify(Bundle.open(bundle.path), [public(keys[1]), public(keys[0])]) == made
    assert (made.release, made.bundle) == (7, bundle.hash)


def test_a_private_key_is_for_its_owner_alone_and_never_replaced(keys, tmp_path):
    assert stat.S_IMODE(keys[0].stat().st_mode) == 0o600
    with pytest.raises(OutputError, match="exists already"):
        new_key(keys[0])
    (tmp_path / "k.pub").touch()
    with pytest.raises(OutputError, match="exists already"):
        new_key(tmp_path / "k")
    assert not (tmp_path / "k").exists()


@pytest.mark.parametrize("name", ["", ".", "/"])
def test_a_path_without_a_name_is_no_place_for_a_key(name):
    with pytest.raises(OutputError, match="not the name of a file"):
        new_key(Path(name))


def test_a_key_that_others_can_read_is_refused(bundle, keys, tmp_path):
    loose = Path(shutil.copy(keys[0], tmp_path / "loose"))
    loose.chmod(0o640)
    with pytest.raises(SignatureError, match="Others can read") as caught:
        sign(bundle, loose, 1)
    assert "chmod 600" in caught.value.fix


def test_another_key_is_refused(bundle, keys):
    sign(bundle, keys[1], 1)
    with pytest.raises(SignatureError, match="not trusted here"):
        verify(bundle, [public(keys[0])])


def test_the_name_of_a_trusted_key_does_not_help_who_lacks_it(bundle, keys):
    made = json.loads(sign(bundle, keys[1], 1).encode())
    forged = signature.Signature(**{**made, "key": public(keys[0])})
    (bundle.path / SIGNATURE).write_bytes(forged.encode())
    with pytest.raises(SignatureError, match="did not sign this"):
        verify(bundle, [public(keys[0])])


def test_another_release_number_is_refused(bundle, keys):
    made = json.loads(sign(bundle, keys[0], 1).encode())
    (bundle.path / SIGNATURE).write_bytes(signature.Signature(**{**made, "release": 2}).encode())
    with pytest.raises(SignatureError, match="did not sign this"):
        verify(bundle, [public(keys[0])])


def test_the_signature_of_another_bundle_is_refused(bundle, keys, tmp_path):
    other = bundle_of(tmp_path / "other", 2)
    sign(other, keys[0], 1)
    shutil.copy(other.path / SIGNATURE, bundle.path)
    with pytest.raises(SignatureError, match="of another bundle"):
        verify(bundle, [public(keys[0])])


def test_files_of_two_signed_bundles_do_not_mix(bundle, keys, tmp_path):
    other = bundle_of(tmp_path / "other", 2)
    for one in (bundle, other):
        sign(one, keys[0], 1)
    shutil.copy(other.path / "graphs/main.onnx", bundle.path / "graphs/main.onnx")
    with pytest.raises(BundleError, match="has changed"):
        Bundle.open(bundle.path)


def test_every_truncation_and_change_of_a_signature_is_refused(bundle, keys):
    content = sign(bundle, keys[0], 3).encode()
    trusted = [public(keys[0])]
    for at in range(0, len(content), 5):
        for changed in (content[:at], content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :],
                        content[:at] + b" " + content[at:]):  # fmt: skip
            (bundle.path / SIGNATURE).write_bytes(changed)
            with pytest.raises(SignatureError, match=r"damaged|did not sign|another bundle|not trusted"):
                verify(bundle, trusted)


@pytest.mark.parametrize("kind", ["none", "folder", "link", "large"])
def test_what_is_not_a_signature_is_refused(bundle, keys, kind):
    path = bundle.path / SIGNATURE
    {"none": lambda: None, "folder": path.mkdir, "link": lambda: path.symlink_to("/dev/zero"),
     "large": lambda: path.write_bytes(b"{" * 100_000)}[kind]()  # fmt: skip
    with pytest.raises(SignatureError, match=r"no signature|cannot be read|damaged"):
        verify(bundle, [public(keys[0])])


@pytest.mark.parametrize(
    "content", [b"", b"-----BEGIN PUBLIC KEY-----\nxx\n-----END PUBLIC KEY-----\n", b"\xff" * 20_000]
)
def test_what_is_not_a_key_is_refused(bundle, tmp_path, content):
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(0o600)
    for use in (lambda: public_key(path), lambda: sign(bundle, path, 1)):
        with pytest.raises(SignatureError, match=r"not a p|too large"):
            use()
    with pytest.raises(SignatureError, match="cannot be read"):
        public_key(tmp_path / "none")


def test_a_key_of_another_algorithm_is_refused(bundle, tmp_path):
    from cryptography.hazmat.primitives import serialization as text
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    pem = text.Encoding.PEM
    private, public = tmp_path / "key", tmp_path / "key.pub"
    private.write_bytes(key.private_bytes(pem, text.PrivateFormat.PKCS8, text.NoEncryption()))
    private.chmod(0o600)
    public.write_bytes(key.public_key().public_bytes(pem, text.PublicFormat.SubjectPublicKeyInfo))
    for use in (lambda: public_key(public), lambda: sign(bundle, private, 1)):
        with pytest.raises(SignatureError, match="not of Ed25519"):
            use()


def test_without_cryptography_its_name_is_told(bundle, keys, monkeypatch):
    content = sign(bundle, keys[0], 1)
    for name in [name for name in sys.modules if name.partition(".")[0] == "cryptography"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    for use in (lambda: verify(bundle, [content.key]), lambda: sign(bundle, keys[0], 1), lambda: public_key(keys[0])):
        with pytest.raises(MissingExtra, match="'cryptography', which the extra 'sign' provides"):
            use()


def test_a_directory_that_vlatool_wrote_can_be_replaced_after_it_was_signed(plain, keys, tmp_path):
    target = tmp_path / "out"
    with write_directory(target) as draft:
        shutil.copytree(plain.path, draft, dirs_exist_ok=True)
    sign(Bundle.open(target), keys[0], 1)
    with write_directory(target, force=True) as draft:
        shutil.copytree(plain.path, draft, dirs_exist_ok=True)
    assert not (target / SIGNATURE).exists()
