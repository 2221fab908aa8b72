from dataclasses import replace
from pathlib import Path

import numpy as np

from vlatool.bundle import Bundle, hash_file
from vlatool.finish import carry_over, reseal, save_npz
from vlatool.runtime import load
from vlatool.runtime.policy import load_golden


def test_equal_arrays_give_equal_bytes(tmp_path: Path):
    arrays = {"a": np.arange(5.0), "text": np.array(["x", "yz"]), "scalar": np.float32(3)}
    for name in ("one.npz", "two.npz"):
        save_npz(tmp_path / name, arrays)
    assert hash_file(tmp_path / "one.npz") == hash_file(tmp_path / "two.npz")
    with np.load(tmp_path / "one.npz", allow_pickle=False) as stored:
        for name, array in arrays.items():
            np.testing.assert_array_equal(stored[name], array)


def test_folders_are_carried_over_and_others_are_not(tmp_path: Path, float_bundle):
    carry_over(float_bundle, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["assets", "data"]
    carry_over(float_bundle, tmp_path / "other", ("assets", "no_such_folder"))
    assert sorted(path.name for path in (tmp_path / "other").iterdir()) == ["assets"]


def test_a_bundle_can_be_sealed_elsewhere_under_another_manifest(tmp_path: Path, float_bundle):
    manifest = replace(float_bundle.manifest, accuracy={"success": {"value": 0.9}})
    reseal(float_bundle, tmp_path, manifest, ("graphs", "assets", "golden"))
    opened = Bundle.open(tmp_path)
    assert opened.manifest.accuracy == {"success": {"value": 0.9}}
    assert not any(name.startswith("data/") for name in opened.manifest.files)
    assert load(tmp_path, threads=1).golden_error == 0.0


def test_a_derived_bundle_names_its_parent_and_keeps_the_policy(source_bundle, float_bundle):
    source, made = source_bundle.manifest, float_bundle.manifest
    assert made.parent == source_bundle.hash
    assert made.made_by["stage"] == "export.onnx"
    for name in ("name", "version", "spec", "program", "environment", "parts", "description", "license"):
        assert getattr(made, name) == getattr(source, name)
    assert made.source["factory"] == "policy.py:make"
    assert "arguments" not in made.source


def test_the_golden_file_holds_inputs_and_the_raw_action(float_bundle):
    golden = load_golden(float_bundle)
    assert golden is not None
    observation, noise, expected = golden
    assert set(observation) == {"image", "proprio", "instruction"}
    assert observation["instruction"] == "go to the ball"
    assert noise == {}
    assert expected.shape == (1, 4, 2)
    with np.load(float_bundle.file(float_bundle.manifest.golden)) as stored:
        assert len(stored["in.image"]) == 2
