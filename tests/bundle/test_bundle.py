import hashlib
import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from vlatool.bundle.bundle import (
    DIGEST,
    LOCATION,
    Bundle,
    digest_of,
    hash_file,
    manifest_bytes,
    seal,
    write_manifest,
)
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError
from vlatool.files.ownership import LEDGER

MANIFEST = Manifest("tiny", "1.0.0", PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0))


def fill(directory: Path) -> Path:
    (directory / "graphs").mkdir(parents=True)
    (directory / "graphs/main.onnx").write_bytes(b"weights" * 100)
    (directory / "assets").mkdir()
    (directory / "assets/words.json").write_text("{}")
    return directory


def rewrite(bundle: Bundle, text: bytes) -> None:
    """Write another manifest and its digest."""
    (bundle.path / "manifest.json").write_bytes(text)
    (bundle.path / DIGEST).write_bytes(digest_of(text))


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


@pytest.mark.parametrize("size", [0, 5, (1 << 20) + 7])
def test_a_file_is_hashed_whole(tmp_path, size):
    (tmp_path / "file").write_bytes(bytes(size))
    assert hash_file(tmp_path / "file") == hashlib.sha256(bytes(size)).hexdigest()


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
    with pytest.raises(BundleError, match="No bundle at"):
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


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "Expecting value"),
        (b'{"schema": 1,', "Expecting property name"),
        (b"\xff\xfe", "utf-8"),
        (b'{"schema": 1, "schema": 1}', "'schema' occurs twice"),
        (b'{"schema": NaN}', "NaN is not a number"),
        (b'{"schema": 1e999}', "1e999 is too large"),
        (b'{"schema": %s}' % (b"1" * 5000), "a number of 5000 digits"),
        (b'{"name": "\\ud800"}', "half of a character"),
        (b"[" * 100000, "too deep"),
        (b"[" * 70 + b"]" * 70, "the limit 'json_depth'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_manifest_that_is_no_json(bundle, text, reason):
    rewrite(bundle, text)
    with pytest.raises(BundleError, match=r"manifest.json is not valid JSON") as caught:
        Bundle.open(bundle.path)
    assert reason in caught.value.message


def test_a_manifest_larger_than_the_limit_is_not_read(bundle, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "manifest_bytes=300")
    with pytest.raises(BundleError, match="the limit 'manifest_bytes' allows 300"):
        Bundle.open(bundle.path)


def test_a_manifest_of_a_million_files_is_refused(bundle):
    data = json.loads((bundle.path / "manifest.json").read_text())
    data["files"] = {str(number): {"sha256": "0" * 64, "bytes": 1} for number in range(10_001)}
    rewrite(bundle, json.dumps(data).encode())
    with pytest.raises(BundleError, match="10001 files; the limit 'files' allows 10000"):
        Bundle.open(bundle.path)


@pytest.mark.parametrize("bit", range(8))
def test_a_flipped_bit_of_the_manifest_or_its_digest_is_seen(bundle, bit):
    for name in ("manifest.json", DIGEST):
        before = (bundle.path / name).read_bytes()
        for at in range(0, len(before), 7):
            changed = bytearray(before)
            changed[at] ^= 1 << bit
            (bundle.path / name).write_bytes(changed)
            with pytest.raises(BundleError, match=r"manifest.json has changed"):
                Bundle.open(bundle.path)
        (bundle.path / name).write_bytes(before)
    assert Bundle.open(bundle.path) == bundle


def test_the_digest_is_one_that_sha256sum_reads(bundle):
    told = subprocess.run(["sha256sum", "-c", DIGEST], cwd=bundle.path, capture_output=True, text=True, check=False)
    assert (told.returncode, told.stdout) == (0, "manifest.json: OK\n")


def test_a_bundle_without_a_digest_is_refused_and_says_how_to_write_one(bundle):
    (bundle.path / DIGEST).unlink()
    with pytest.raises(BundleError, match=r"has no manifest.sha256") as caught:
        Bundle.open(bundle.path)
    command = caught.value.fix.partition(": ")[2]
    subprocess.run(command, shell=True, check=True)
    assert Bundle.open(bundle.path) == bundle


@pytest.mark.parametrize("name", ["new.txt", "assets/new.txt", "graphs/more/weights.data", ".hidden"])
def test_a_file_that_the_manifest_does_not_record_is_refused(bundle, name):
    (bundle.path / name).parent.mkdir(exist_ok=True)
    (bundle.path / name).touch()
    with pytest.raises(BundleError, match=f"holds {name}, which its manifest does not record") as caught:
        Bundle.open(bundle.path)
    assert "remove it" in caught.value.fix


def test_what_is_written_about_a_bundle_and_what_desktops_leave_is_no_part_of_it(bundle):
    (bundle.path / "reports").mkdir()
    (bundle.path / "empty").mkdir()
    for name in ("reports/report.html", "recipe.yaml", "SIGNATURE", ".DS_Store", "graphs/Thumbs.db"):
        (bundle.path / name).touch()
    assert Bundle.open(bundle.path) == bundle
    assert seal(bundle.path, MANIFEST).manifest.files == bundle.manifest.files


@pytest.mark.parametrize(
    "name",
    ["reports", "reports/report.html", "reports/deep/er", "recipe.yaml", "SIGNATURE", "graphs/.DS_Store", LEDGER],
)
def test_no_free_name_is_a_link(tmp_path: Path, bundle, name):
    (tmp_path / "victim").mkdir()
    (bundle.path / name).parent.mkdir(parents=True, exist_ok=True)
    (bundle.path / name).symlink_to(tmp_path / "victim")
    with pytest.raises(BundleError, match=rf"holds {name}, which is a link"):
        Bundle.open(bundle.path)


@pytest.mark.parametrize("name", ["recipe.yaml/x.py", "graphs/.DS_Store/x.py", "SIGNATURE/x.py"])
def test_a_directory_of_a_free_name_hides_nothing(bundle, name):
    (bundle.path / name).parent.mkdir(parents=True)
    (bundle.path / name).touch()
    with pytest.raises(BundleError, match=rf"holds {name}, which its manifest does not record"):
        Bundle.open(bundle.path)


def test_a_pipe_in_the_reports_is_refused(bundle):
    (bundle.path / "reports").mkdir()
    os.mkfifo(bundle.path / "reports/report.html")
    with pytest.raises(BundleError, match=r"holds reports/report.html"):
        Bundle.open(bundle.path)


def test_more_bytes_than_a_bundle_may_have_are_refused_before_one_is_read(bundle):
    size = 1 << 43
    (bundle.path / "graphs/z.bin").touch()
    os.truncate(bundle.path / "graphs/z.bin", size)
    records = {**bundle.manifest.files, "graphs/z.bin": FileRecord("0" * 64, size)}
    write_manifest(bundle.path, replace(bundle.manifest, files=records))
    with pytest.raises(BundleError, match=rf"has {size + 702} bytes; the limit 'bundle_bytes' allows") as caught:
        Bundle.open(bundle.path)
    assert f"VLATOOL_LIMITS=bundle_bytes={size + 702}" in caught.value.fix


def test_a_linked_directory_is_refused_at_every_level(tmp_path: Path, bundle):
    shutil.move(bundle.path / "graphs", tmp_path / "elsewhere")
    (bundle.path / "graphs").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BundleError, match=r"holds graphs, which"):
        Bundle.open(bundle.path)
    for call in (bundle.read, bundle.file):
        with pytest.raises(BundleError, match=r"lacks the file graphs/main.onnx \(missing, or a link\)"):
            call("graphs/main.onnx")


def test_the_path_to_a_bundle_may_be_a_link(tmp_path: Path, bundle):
    (tmp_path / "current").symlink_to(bundle.path)
    assert Bundle.open(tmp_path / "current").manifest == bundle.manifest


def test_what_is_read_is_what_was_hashed(bundle):
    assert bundle.read("assets/words.json") == b"{}" == bundle.asset("words.json")
    (bundle.path / "assets/words.json").write_text("[]")
    with pytest.raises(BundleError, match=r"words.json has changed: its SHA-256"):
        bundle.read("assets/words.json")


def test_a_file_larger_than_its_limit_is_not_read(bundle, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "tokenizer_bytes=1")
    with pytest.raises(BundleError, match=r"words.json has 2 bytes; the limit 'tokenizer_bytes' allows 1"):
        bundle.asset("words.json", "tokenizer_bytes")


def test_a_pipe_in_the_place_of_a_file_is_seen_and_not_waited_for(bundle):
    (bundle.path / "assets/words.json").unlink()
    os.mkfifo(bundle.path / "assets/words.json")
    with pytest.raises(BundleError, match=r"lacks the file assets/words.json"):
        Bundle.open(bundle.path)


@pytest.mark.parametrize("golden", ["golden/golden.npz", "graphs/other.onnx"])
def test_a_golden_file_without_a_record_is_refused(bundle, golden):
    seal(bundle.path, replace(MANIFEST, golden=golden))
    with pytest.raises(BundleError, match=f"names {golden}, the golden file, but records no hash"):
        Bundle.open(bundle.path)


def test_the_size_of_the_graphs_counts_everything_beside_them(bundle):
    graphs = {"main": Graph("main.onnx")}
    for name in ("main.onnx", "weights.data"):
        (bundle.path / name).write_bytes(b"12345")
    program = single_graph(MANIFEST.spec)
    sealed = seal(bundle.path, MANIFEST)
    assert replace(sealed, manifest=replace(sealed.manifest, graphs=graphs, program=program)).graph_bytes == 10


def test_files_that_an_engine_opens_by_name_are_those_that_were_hashed(bundle):
    with bundle.verified_folder("graphs", ["graphs/main.onnx"]) as place:
        assert (place / "main.onnx").read_bytes() == b"weights" * 100


def rename_over(folder: Path) -> None:
    (folder / "new").write_bytes(b"weights" * 100)
    (folder / "new").replace(folder / "main.onnx")


def swap_and_swap_back(folder: Path) -> None:
    folder.rename(folder.with_name("away"))
    shutil.copytree(folder.with_name("away"), folder)
    shutil.rmtree(folder)
    folder.with_name("away").rename(folder)


def rewrite_in_place(folder: Path) -> None:
    found = (folder / "main.onnx").stat()
    with (folder / "main.onnx").open("r+b") as stream:
        stream.write(b"WEIGHTS")
    os.utime(folder / "main.onnx", ns=(found.st_atime_ns, found.st_mtime_ns))


@pytest.mark.parametrize("attack", [rename_over, swap_and_swap_back, rewrite_in_place])
def test_what_changes_while_an_engine_opens_it_is_seen(bundle, attack):
    with pytest.raises(BundleError, match="was changed while"), bundle.verified_folder("graphs", ["graphs/main.onnx"]):
        attack(bundle.path / "graphs")


def test_a_held_file_is_verified(bundle):
    (bundle.path / "graphs/main.onnx").write_bytes(b"Weights" * 100)
    with pytest.raises(BundleError, match="its SHA-256"), bundle.verified_folder("graphs", ["graphs/main.onnx"]):
        pytest.fail("the block must not run")


def test_a_manifest_that_is_a_link_is_refused(tmp_path: Path, bundle):
    shutil.move(bundle.path / "manifest.json", tmp_path / "elsewhere.json")
    (bundle.path / "manifest.json").symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(BundleError, match=r"lacks the file manifest.json \(missing, or a link\)"):
        Bundle.open(bundle.path)


def test_a_newer_bundle_asks_for_an_upgrade(bundle):
    data = json.loads((bundle.path / "manifest.json").read_text())
    rewrite(bundle, json.dumps({**data, "schema": 9}).encode())
    with pytest.raises(BundleError, match="schema 9") as caught:
        Bundle.open(bundle.path)
    assert caught.value.fix == "upgrade vlatool"
