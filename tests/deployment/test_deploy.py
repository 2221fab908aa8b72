"""Deployment: what is older, unsigned, of another contract or wrong is refused before it can be active."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _slots import TRIAL, X, bundle_of, install

from vlatool.bundle.bundle import Bundle, replace_manifest, seal
from vlatool.deployment import shadow
from vlatool.deployment.deploy import Conditions, deploy
from vlatool.deployment.judge import check_contract, inference_period_ms
from vlatool.deployment.shadow import MIN_RUNS, ShadowJob
from vlatool.deployment.signature import SIGNATURE, new_key, public_key, sign
from vlatool.deployment.store import Store
from vlatool.errors import (
    BundleError,
    DataError,
    DeploymentError,
    GraphError,
    OutputError,
    SignatureError,
    SpecError,
    UsageError,
)


def tell(_what, _share):
    """Take progress."""


@pytest.fixture(scope="module")
def key(tmp_path_factory) -> Path:
    return new_key(tmp_path_factory.mktemp("keys") / "key").with_suffix("")


@pytest.fixture
def store(tmp_path, key) -> Store:
    """A store that requires signatures, with release 5 of version 1.2.0 in it."""
    found = Store(tmp_path / "store")
    bundle = bundle_of(tmp_path / "first", 1, "1.2.0")
    install(found, bundle, release=5)
    with found.lock() as pointer:
        found.write(replace(pointer, keys=(public_key(Path(f"{key}.pub")),), highest_release=5,
                            highest_bundle=bundle.hash, highest_version="1.2.0"))  # fmt: skip
    return found


def candidate(tmp_path: Path, key: Path | None, release: int = 6, version: str = "1.3.0", **changes) -> Path:
    bundle = bundle_of(tmp_path / "candidate", 2, version, **changes)
    if key is not None:
        sign(bundle, key, release)
    return bundle.path


def refused(store: Store, path: Path, error: type[Exception], match: str, **conditions) -> Exception:
    """Deploy what must be refused before the other slot is touched; return the error."""
    before = store.read()
    with pytest.raises(error, match=match) as caught:
        deploy(store, path, Conditions(**conditions), tell)
    assert store.read() == before
    assert caught.value.exit_code == 3
    assert caught.value.fix
    return caught.value


def test_an_unsigned_bundle(store, tmp_path):
    refused(store, candidate(tmp_path, None), SignatureError, "has no signature")


def test_another_key(store, tmp_path):
    new_key(tmp_path / "theirs")
    path = candidate(tmp_path, tmp_path / "theirs")
    refused(store, path, SignatureError, "not trusted here")
    theirs = public_key(tmp_path / "theirs.pub")
    refused(store, path, SignatureError, "requires another key", key=theirs)


def test_a_replay_of_an_older_release(store, tmp_path, key):
    error = refused(store, candidate(tmp_path, key, release=4), DeploymentError, "release 4, older than release 5")
    assert "--downgrade-to sha256:" in error.fix


def test_two_bundles_of_one_release(store, tmp_path, key):
    refused(store, candidate(tmp_path, key, release=5), DeploymentError, "release 5, as another bundle")


def test_an_older_version_of_a_newer_release(store, tmp_path, key):
    refused(store, candidate(tmp_path, key, version="1.1.9"), DeploymentError, r"version 1\.1\.9, older than 1\.2\.0")


@pytest.mark.parametrize("named", ["sha256:", "yes", "sha256:000000000000", "sha256:0000000000000000"])
def test_a_downgrade_must_be_named_by_the_hash_of_its_bundle(store, tmp_path, key, named):
    path = candidate(tmp_path, key, release=4)
    refused(store, path, DeploymentError, "older than release 5", downgrade_to=named)


@pytest.mark.parametrize("named", ["sha256:xx", "sha256:" + "0" * 64])
def test_another_bundle_than_the_one_that_is_named_is_refused(store, tmp_path, key, named):
    path = candidate(tmp_path, key)
    refused(store, path, DeploymentError, "which --downgrade-to names", downgrade_to=named)


def test_a_truncated_signature(store, tmp_path, key):
    path = candidate(tmp_path, key)
    (path / SIGNATURE).write_bytes((path / SIGNATURE).read_bytes()[:-20])
    refused(store, path, SignatureError, "damaged")


def test_mixed_files_of_two_signed_bundles(store, tmp_path, key):
    path = candidate(tmp_path, key)
    shutil.copy(store.folder("a") / "graphs/main.onnx", path / "graphs/main.onnx")
    refused(store, path, BundleError, "has changed")


def test_a_manifest_that_was_changed_after_it_was_signed(store, tmp_path, key):
    path = candidate(tmp_path, key)
    bundle = Bundle.open(path)
    replace_manifest(bundle, replace(bundle.manifest, version="9.0.0"))
    refused(store, path, SignatureError, "of another bundle")


def test_a_bundle_in_which_a_stage_found_something_wrong(store, tmp_path, key):
    bundle = Bundle.open(candidate(tmp_path, None))
    changed = replace_manifest(bundle, replace(bundle.manifest, findings=({"name": "bad", "message": "It is bad."},)))
    sign(changed, key, 6)
    refused(store, bundle.path, GraphError, "It is bad")


def test_the_active_bundle_and_one_beside_a_trial(store, tmp_path, key):
    active = Path(shutil.copytree(store.folder("a"), tmp_path / "same"))
    refused(store, active, DeploymentError, "is the active bundle already")
    other = bundle_of(tmp_path / "other", 3, "1.2.1")
    install(store, other)
    store.count_start(other.hash, 1)
    refused(store, candidate(tmp_path, key), DeploymentError, "has a bundle on trial")


CHANGES = {
    "control_hz": {"control_hz": 20.0}, "execute": {"execute": 2}, "input": {"inputs": (replace(X, name="z"),)},
    "unit": {"inputs": (replace(X, unit="m"),)}, "labels": {"inputs": (replace(X, labels=("p", "q")),)},
}  # fmt: skip


@pytest.mark.parametrize("changes", CHANGES.values(), ids=CHANGES)
def test_another_contract(tmp_path, changes):
    old = bundle_of(tmp_path / "old", 1).manifest.spec
    with pytest.raises(SpecError, match="another contract than the active one") as caught:
        check_contract(replace(old, **changes), old)
    assert "--new-contract" in caught.value.fix


def test_another_contract_is_refused_by_deploy(store, tmp_path, key):
    refused(store, candidate(tmp_path, key, control_hz=20.0), SpecError, "control_hz is 20.0, before 10.0")


def test_a_full_disk_is_found_out_before_the_other_slot_is_emptied(store, tmp_path, key, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: shutil._ntuple_diskusage(9, 9, 1_000))
    refused(store, candidate(tmp_path, key), OutputError, "too full")


def test_a_trial_that_nobody_began_makes_way(store, tmp_path, key):
    install(store, bundle_of(tmp_path / "other", 3, "1.2.1"), TRIAL)
    path = candidate(tmp_path, key, control_hz=20.0)
    refused(store, path, SpecError, "another contract")
    assert store.read().active == "b", "a bundle that is refused moves nothing"
    path = candidate(tmp_path / "next", key)
    before = bundle_of(tmp_path / "whole", 1, "1.2.0").hash
    deploy(store, path, Conditions(runs=32), tell)
    assert {name: slot.bundle for name, slot in store.read().slots.items()} == {
        "a": before,
        "b": Bundle.open(path).hash,
    }


def test_a_trial_that_nobody_began_stays_where_the_bundle_before_it_is_damaged(store, tmp_path, key):
    install(store, bundle_of(tmp_path / "other", 3, "1.2.1"), TRIAL)
    shutil.rmtree(store.folder("a"))
    np.savez(tmp_path / "recording.npz", y=np.zeros(1))
    path, conditions = candidate(tmp_path, key), Conditions(recording=str(tmp_path / "recording.npz"))
    with pytest.raises(DataError, match="no array 'x'"):
        deploy(store, path, conditions, tell)
    assert (store.read().active, list(store.read().slots)) == ("b", ["b"])


def test_a_bundle_in_the_slot_that_is_emptied_for_it_is_refused(store, tmp_path):
    install(store, bundle_of(tmp_path / "other", 3, "1.2.1"), None)
    with store.lock() as pointer:
        store.write(replace(pointer, keys=()))
    (tmp_path / "link").symlink_to(store.folder("a"))
    for path in (store.folder("a"), tmp_path / "link"):
        refused(store, path, DeploymentError, "slot that it would be copied into", downgrade_to=Bundle.open(path).hash)
        assert Bundle.open(path)


@pytest.mark.parametrize("wrong", [
    {"latency_ms": float("inf")}, {"latency_ms": float("nan")}, {"latency_ms": -1.0}, {"seconds": float("inf")},
    {"seconds": 1e300}, {"memory_mb": float("inf")}, {"first_run_s": float("inf")}, {"first_run_s": 0.0},
    {"ticks": 10**20}, {"ticks": -1}, {"runs": 0}, {"threads": 0},
], ids=str)  # fmt: skip
def test_a_condition_that_cannot_be_kept_is_refused_before_anything_is_done(wrong):
    with pytest.raises(UsageError, match="allowed"):
        Conditions(**wrong)


@pytest.mark.parametrize(("new", "old", "older"), [
    ("1.9", "1.10", True), ("1.10", "1.9", False), ("1.2", "1.2.0", False), ("v1.0", "1.1", True),
    ("main", "1.0", False), ("1.0", "main", False), ("2024.1", "2023.9", False), ("0.9-rc1", "1.0", True),
])  # fmt: skip
def test_versions_are_compared_as_numbers(tmp_path, new, old, older):
    store = Store(tmp_path / "store")
    install(store, bundle_of(tmp_path / "one", 1, "0.0.0"))
    with store.lock() as pointer:
        store.write(replace(pointer, highest_version=old))
    path = bundle_of(tmp_path / "two", 2, new, control_hz=20.0).path
    error = DeploymentError if older else SpecError  # the contract is looked at next
    refused(store, path, error, "older than" if older else "another contract")


# the shadow run, in this process


def run(bundle: Bundle, recording: Path | None = None, **limits) -> dict:
    return shadow._run(ShadowJob(bundle.path, "", 1, 10.0, 2000.0, 60.0, recording, MIN_RUNS, **limits))


def test_a_shadow_run_answers_recorded_and_golden_observations(tmp_path):
    bundle = bundle_of(tmp_path / "good", 1)
    np.savez(tmp_path / "r.npz", x=np.ones((5, 2), np.float32))
    for recording in (None, tmp_path / "r.npz"):
        found = run(bundle, recording)
        assert (found["runs"], found["violation"]) == (MIN_RUNS, "")
        assert 0 < found["p50_ms"] <= found["p95_ms"] <= found["worst_ms"]


def test_a_slow_bundle_fails_its_shadow_run(tmp_path):
    assert "took longer than 1e-06 ms" in run(bundle_of(tmp_path / "slow", 1), latency_ms=1e-6)["violation"]


def test_a_bundle_that_is_not_finite_on_a_recording_fails(tmp_path):
    np.savez(tmp_path / "r.npz", x=np.array([[1, 1], [1, np.float32(3.4e38)]], np.float32))
    bundle = bundle_of(tmp_path / "good", 1, golden=False)
    text = (bundle.path / "graphs/main.onnx").read_bytes().replace(b"Sub", b"Mul")
    assert len(text) == (bundle.path / "graphs/main.onnx").stat().st_size
    (bundle.path / "graphs/main.onnx").write_bytes(text)
    with pytest.raises(GraphError, match="not finite"):
        run(seal(bundle.path, bundle.manifest), tmp_path / "r.npz")


@pytest.mark.parametrize(("arrays", "match"), [
    ({"z": np.ones((1, 2))}, "has no array 'x'"), ({"x": np.ones((0, 2))}, "no samples"),
])  # fmt: skip
def test_a_recording_that_does_not_fit(tmp_path, arrays, match):
    np.savez(tmp_path / "r.npz", **arrays)
    with pytest.raises(DataError, match=match):
        run(bundle_of(tmp_path / "good", 1), tmp_path / "r.npz")


def test_without_golden_observations_a_recording_is_asked_for(tmp_path):
    with pytest.raises(DataError, match="no golden observation") as caught:
        run(bundle_of(tmp_path / "good", 1, golden=False))
    assert "--recording" in caught.value.fix


def test_the_limit_is_the_time_between_two_inferences(tmp_path):
    spec = bundle_of(tmp_path / "good", 1).manifest.spec
    assert inference_period_ms(spec) == pytest.approx(300.0)
    assert inference_period_ms(replace(spec, execute=1)) == pytest.approx(100.0)
    assert inference_period_ms(replace(spec, control_hz=None)) == 0.0
