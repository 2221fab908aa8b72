"""The store: the active slot is whole at every instant, and what is damaged is refused by name."""

import dataclasses
import fcntl
import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from _slots import TRIAL, bundle_of, install

from vlatool.bundle.bundle import Bundle
from vlatool.deployment import pointer as pointer_module
from vlatool.deployment import store as store_module
from vlatool.deployment.deploy import roll_back, status
from vlatool.deployment.pointer import FILES, Pointer, decode, encode, read_pointer
from vlatool.deployment.store import Store
from vlatool.errors import BundleError, DeploymentError, OutputError


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "deep" / "store")


@pytest.fixture(scope="module")
def bundles(tmp_path_factory) -> list[Bundle]:
    folder = tmp_path_factory.mktemp("bundles")
    return [bundle_of(folder / str(value), value) for value in (1, 2, 3)]


def test_bundles_take_turns_in_two_slots(store, bundles):
    for number, bundle in enumerate(bundles):
        slot = install(store, bundle, trial=None)
        pointer = store.read()
        assert pointer.active == "aba"[number]
        assert pointer.current == slot
        assert Bundle.open(store.folder(pointer.active)).hash == bundle.hash
    assert {slot.bundle for slot in store.read().slots.values()} == {bundles[1].hash, bundles[2].hash}
    assert sorted(path.name for path in store.path.iterdir()) == ["a", "b", *sorted(FILES)]


def test_the_first_bundle_has_no_trial_since_nothing_could_be_gone_back_to(store, bundles):
    install(store, bundles[0])
    assert store.read().trial is None
    install(store, bundles[1])
    assert store.read().trial == TRIAL


@pytest.mark.parametrize("name", ["manifest.json", "policy.py", "photo.jpg"])
def test_a_directory_of_something_else_is_refused_and_not_changed(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(DeploymentError, match=f"is not a store: it holds other files .found: {name}"):
        Store(tmp_path).make()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_file_is_no_store(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DeploymentError, match="is not a store: it is a file"):
        Store(tmp_path / "file").make()


@pytest.mark.parametrize("names", [[], ["a"], ["lost+found"], [".pointer.json.part"], [FILES[0], "note.txt"]])
def test_an_empty_an_interrupted_and_a_used_store_are_used(tmp_path, names):
    for name in names:
        (tmp_path / name).write_bytes(b"")
    Store(tmp_path).make()


def test_rollback_and_back_again(store, bundles):
    install(store, bundles[0])
    install(store, bundles[1], trial=None)
    assert roll_back(store)["slots"][store.read().active]["bundle"] == bundles[0].hash
    roll_back(store)
    assert store.read().current.bundle == bundles[1].hash


def test_a_rollback_of_a_trial_drops_the_slot(store, bundles):
    install(store, bundles[0])
    install(store, bundles[1])
    found = roll_back(store, "it shook")
    assert (found["last_rollback"], list(found["slots"]), found["trial"]) == ("it shook", [found["active"]], None)
    with pytest.raises(DeploymentError, match="no other bundle to go back to"):
        roll_back(store)


def test_a_rollback_to_a_damaged_bundle_is_refused(store, bundles):
    install(store, bundles[0])
    install(store, bundles[1], trial=None)
    (store.folder(store.read().inactive) / "graphs/main.onnx").write_bytes(b"x")
    with pytest.raises(DeploymentError, match="bundle to go back to is damaged"):
        roll_back(store)
    assert store.read().current.bundle == bundles[1].hash


def test_a_rollback_of_another_bundle_than_the_active_one_does_nothing(store, bundles):
    install(store, bundles[0])
    install(store, bundles[1])
    assert store.roll_back("late news", bundles[0].hash).current.bundle == bundles[1].hash


@pytest.mark.parametrize("name", ["pointer.json", "pointer.copy.json"])
@pytest.mark.parametrize("earlier", [0, 1])
def test_a_pointer_of_which_one_file_cannot_be_written_is_the_old_one(store, bundles, monkeypatch, name, earlier):
    for bundle in bundles[:earlier]:
        install(store, bundle)
    store.make()
    before = store.read()
    replace_file = pointer_module.replace_file

    def full(path, content):
        if path.name == name and b'"active"' in content and bundles[1].hash.encode() in content:
            raise OSError(28, "No space left on device", str(path))
        replace_file(path, content)

    monkeypatch.setattr(pointer_module, "replace_file", full)
    with pytest.raises(OutputError, match="its disk is full"):
        install(store, bundles[1])
    assert store.read() == before
    (store.path / "pointer.json").unlink(missing_ok=True)
    assert store.read() in (before, Pointer()), "the copy does not say what has not happened"


def test_a_rollback_beside_another_change_is_refused_and_never_does_nothing(store, bundles):
    install(store, bundles[0])
    install(store, bundles[1], trial=None)
    with store.lock(), pytest.raises(DeploymentError, match="Another process"):
        roll_back(store)
    assert roll_back(store)["active"] == "a"


def test_a_copy_that_fails_leaves_the_active_slot(store, bundles, monkeypatch):
    install(store, bundles[0])

    def full(path, pieces):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(store_module, "write_file", full)
    with pytest.raises(OutputError, match="its disk is full"):
        install(store, bundles[1])
    assert status(store, store.read())["slots"]["a"]["problem"] == ""


def test_a_bundle_that_changes_while_it_is_copied_is_refused(store, bundles, tmp_path):
    copy = Bundle.open(shutil.copytree(bundles[0].path, tmp_path / "copy"))
    content = bytearray((copy.path / "graphs/main.onnx").read_bytes())
    content[-1] ^= 1
    (copy.path / "graphs/main.onnx").write_bytes(content)
    with pytest.raises(BundleError, match="has changed"):
        install(store, copy)
    assert store.read().slots == {}


def test_two_changes_at_once_are_refused(store, bundles):
    install(store, bundles[0])
    with store.lock(), pytest.raises(DeploymentError, match="Another process is changing the store"), store.lock():
        pass
    handle = os.open(store.path, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with pytest.raises(DeploymentError, match="Another process"):
        install(store, bundles[1])
    os.close(handle)


def test_an_open_file_of_a_slot_survives_the_next_bundle(store, bundles):
    install(store, bundles[0], trial=None)
    install(store, bundles[1], trial=None)
    with (store.folder(store.read().inactive) / "graphs/main.onnx").open("rb") as held:
        before = held.read()
        install(store, bundles[2], trial=None)
        held.seek(0)
        assert held.read() == before


@pytest.mark.parametrize("damage", ["truncate", "empty", "garbage", "remove", "folder", "link", "list", "extra key"])
def test_a_damaged_pointer_is_read_from_its_copy_and_both_are_refused(store, bundles, damage):
    install(store, bundles[0])
    before = store.read()
    for name in FILES:
        path = store.path / name
        content = path.read_bytes()
        path.unlink()
        if damage == "folder":
            path.mkdir()
        elif damage == "link":
            path.symlink_to(path.with_name("elsewhere"))
        elif damage != "remove":
            extra = json.loads(content) | {"more": 1}
            path.write_bytes({"truncate": content[:-9], "empty": b"", "garbage": b"\xff" * 90, "list": b"[1]",
                              "extra key": json.dumps(extra).encode()}[damage])  # fmt: skip
        if name == FILES[0]:
            assert store.read() == before
    if damage == "remove":
        assert store.read() == Pointer()
    else:
        with pytest.raises(DeploymentError, match="cannot be read"):
            store.read()


def test_every_flipped_byte_of_a_pointer_is_refused(store, bundles):
    install(store, bundles[0])
    install(store, bundles[1])
    content = (store.path / FILES[0]).read_bytes()
    assert encode(decode(content)) == content
    random = np.random.default_rng(0)
    for at in range(len(content)):
        changed = bytearray(content)
        changed[at] ^= int(random.integers(1, 256))
        with pytest.raises(ValueError, match=r"."):
            decode(bytes(changed))


@pytest.mark.parametrize(("field", "value"), [
    ("active", "c"), ("active", ""), ("active", 1), ("slots", {}), ("slots", {"c": {}}), ("slots", []), ("schema", 2),
    ("change", -1), ("change", 2**70), ("change", 1.5), ("keys", ["xx"]), ("keys", "x"), ("highest_release", True),
    ("rollback", None), ("trial", {"ticks": 1}),
    ("trial", {"ticks": 1, "seconds": -1, "latency_ms": 1, "memory_mb": 1}),
])  # fmt: skip
def test_an_impossible_pointer_is_refused_even_with_a_right_digest(store, bundles, field, value):
    install(store, bundles[0])
    install(store, bundles[1])
    plain = {**json.loads((store.path / FILES[0]).read_bytes())["pointer"], field: value}
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()
    with pytest.raises(ValueError, match=r"."):
        decode((json.dumps({"pointer": plain, "sha256": digest}, indent=1) + "\n").encode())


def test_a_slot_with_another_whole_bundle_is_a_problem(store, bundles):
    install(store, bundles[0])
    shutil.rmtree(store.folder("a"))
    shutil.copytree(bundles[1].path, store.folder("a"))
    assert "holds another bundle" in status(store, store.read())["slots"]["a"]["problem"]


def test_a_store_that_is_not_there(tmp_path):
    store = Store(tmp_path / "none")
    assert store.read() == Pointer() == read_pointer(tmp_path / "none")
    for change in (lambda: store.read_deployed(), lambda: roll_back(store)):
        with pytest.raises(DeploymentError, match=r"no store|holds no bundle"):
            change()


def test_a_later_field_with_a_default_does_not_change_what_is_on_the_disk():
    """An update of vlatool on the robot must not make its store unreadable."""
    assert json.loads(encode(Pointer()))["pointer"] == {"schema": 1}


def test_numbers_of_a_trial_have_one_text():
    trial = dataclasses.replace(TRIAL, seconds=1)
    assert json.dumps(trial.seconds) == "1.0"
