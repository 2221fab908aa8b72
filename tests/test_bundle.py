import errno
import json
import os
import shutil
from pathlib import Path

import pytest

from vlatool.bundle import LOCATION, Bundle, _digest, hash_file, manifest_bytes, seal
from vlatool.errors import BundleError
from vlatool.manifest import Manifest
from vlatool.spec import PolicySpec, TensorSpec

MANIFEST = Manifest("tiny", "1.0.0", PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0))


def fill(directory: Path) -> Path:
    (directory / "graphs").mkdir(parents=True)
    (directory / "graphs/main.onnx").write_bytes(b"weights" * 100)
    (directory / "assets").mkdir()
    (directory / "assets/words.json").write_text("{}")
    return directory


@pytest.fixture
def bundle(tmp_path: Path) -> Bundle:
    return seal(fill(tmp_path / "bundle"), MANIFEST)


def test_a_sealed_bundle_opens_equal(bundle):
    opened = Bundle.open(bundle.path)
    assert opened == bundle
    assert set(opened.manifest.files) == {"graphs/main.onnx", "assets/words.json"}
    assert opened.size_bytes == 702
    assert opened.file("assets/words.json").read_text() == "{}"


def test_sealing_is_deterministic(tmp_path: Path, bundle):
    again = seal(fill(tmp_path / "again"), MANIFEST)
    assert again.hash == bundle.hash
    assert (again.path / "manifest.json").read_bytes() == (bundle.path / "manifest.json").read_bytes()


def test_the_hash_is_that_of_the_manifest_file_and_follows_the_content(tmp_path: Path, bundle):
    assert bundle.hash == "sha256:" + hash_file(bundle.path / "manifest.json")
    fill(tmp_path / "other")
    (tmp_path / "other/assets/words.json").write_text("[]")
    assert seal(tmp_path / "other", MANIFEST).hash != bundle.hash


def test_what_is_written_about_a_bundle_does_not_change_its_hash(bundle):
    (bundle.path / "reports").mkdir()
    (bundle.path / "reports/report.json").write_text("{}")
    (bundle.path / LOCATION).write_text("{}")
    assert seal(bundle.path, MANIFEST).hash == bundle.hash


def test_a_manifest_keeps_letters_beyond_ascii(bundle):
    spec = PolicySpec((TensorSpec("x", (1, 2), unit="°"),), (TensorSpec("y", (1, 2)),), 10.0)
    named = Manifest("bras robotisé", "1", spec)
    assert "bras robotisé".encode() in manifest_bytes(named)
    assert Bundle.open(seal(bundle.path, named).path).manifest.name == "bras robotisé"


def test_an_empty_file_is_a_file(bundle):
    (bundle.path / "assets/empty.txt").touch()
    sealed = seal(bundle.path, MANIFEST)
    assert Bundle.open(bundle.path).manifest.files["assets/empty.txt"] == sealed.manifest.files["assets/empty.txt"]


def test_the_digest_for_old_pythons_is_the_same(bundle):
    path = bundle.path / "graphs/main.onnx"
    with path.open("rb") as stream:
        assert _digest(stream) == hash_file(path)


def test_a_file_that_is_not_recorded_is_refused(bundle):
    with pytest.raises(BundleError, match=r"has no file 'graphs/other.onnx'"):
        bundle.file("graphs/other.onnx")


def test_a_missing_file_is_seen(bundle):
    (bundle.path / "graphs/main.onnx").unlink()
    with pytest.raises(BundleError, match=r"lacks the file graphs/main.onnx"):
        Bundle.open(bundle.path)


def test_a_truncated_file_is_seen(bundle):
    os.truncate(bundle.path / "graphs/main.onnx", 699)
    with pytest.raises(BundleError, match=r"main.onnx has 699 bytes; the manifest says 700"):
        Bundle.open(bundle.path)


def test_a_flipped_bit_is_seen(bundle):
    path = bundle.path / "graphs/main.onnx"
    changed = bytearray(path.read_bytes())
    changed[350] ^= 1
    path.write_bytes(changed)
    with pytest.raises(BundleError, match=r"main.onnx has changed: its SHA-256"):
        Bundle.open(bundle.path)


def test_a_link_in_the_place_of_a_file_is_seen(tmp_path: Path, bundle):
    path = bundle.path / "assets/words.json"
    shutil.move(path, tmp_path / "elsewhere.json")
    path.symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(BundleError, match="missing, or a link"):
        Bundle.open(bundle.path)


def test_a_directory_in_the_place_of_a_file_is_seen(bundle):
    (bundle.path / "assets/words.json").unlink()
    (bundle.path / "assets/words.json").mkdir()
    with pytest.raises(BundleError, match=r"lacks the file assets/words.json"):
        Bundle.open(bundle.path)


def test_damage_is_not_looked_for_when_it_is_not_asked_for(bundle):
    (bundle.path / "graphs/main.onnx").unlink()
    assert Bundle.open(bundle.path, verify=False).manifest == bundle.manifest


def test_a_path_that_does_not_exist(tmp_path: Path):
    with pytest.raises(BundleError, match="There is no bundle at"):
        Bundle.open(tmp_path / "nothing")


def test_a_directory_that_is_no_bundle_says_what_is_in_it(tmp_path: Path):
    with pytest.raises(BundleError, match=r"no manifest.json \(found: nothing\)"):
        Bundle.open(tmp_path)
    (tmp_path / "policy.yaml").touch()
    with pytest.raises(BundleError, match=r"\(found: policy.yaml\)") as caught:
        Bundle.open(tmp_path)
    assert "vlatool export" in caught.value.fix


def test_a_file_is_no_bundle(tmp_path: Path):
    (tmp_path / "model.onnx").touch()
    with pytest.raises(BundleError, match=r"is not a bundle.*a file"):
        Bundle.open(tmp_path / "model.onnx")


@pytest.mark.parametrize("text", [b"", b'{"schema": 1,', b"\xff\xfe"])
def test_a_manifest_that_is_no_json(bundle, text):
    (bundle.path / "manifest.json").write_bytes(text)
    with pytest.raises(BundleError, match="not valid JSON"):
        Bundle.open(bundle.path)


def test_a_manifest_that_cannot_be_read(bundle, monkeypatch):
    def refuse(*_args, **_options):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(BundleError, match="cannot be read: Permission denied"):
        Bundle.open(bundle.path)


def test_a_newer_bundle_asks_for_an_upgrade(bundle):
    data = json.loads((bundle.path / "manifest.json").read_text())
    (bundle.path / "manifest.json").write_text(json.dumps({**data, "schema": 9}))
    with pytest.raises(BundleError, match="schema 9") as caught:
        Bundle.open(bundle.path)
    assert caught.value.fix == "upgrade vlatool"
