"""Recordings that a person names beside a policy take the place of those that it names itself, whatever its form."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from _foreign_onnx import F, N, V, model, weight

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.data import calibration_recording, evaluation_recording
from vlatool.errors import DataError, UsageError
from vlatool.module.source import RecordingOptions, Source
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.rebuild.rebuild import rebuild
from vlatool.sources import brings_calibration, source_stage
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform


@pytest.fixture
def bare(policy_dir: Path) -> Path:
    """The tiny policy, which names no recordings; those are beside its folder."""
    for name in ("calibration.npz", "evaluation.npz"):
        if (policy_dir / name).exists():
            shutil.move(policy_dir / name, policy_dir.parent / name)
    return policy_dir


@pytest.fixture
def onnx_file(tmp_path: Path) -> Path:
    """A network of two layers that nobody described."""
    nodes = [N("MatMul", ["state", "W"], ["hidden"]), N("MatMul", ["hidden", "U"], ["action"])]
    ends = ((V("state", F, [1, 4]),), (V("action", F, [1, 2]),))
    onnx.save(model(nodes, [weight("W", 4, 16), weight("U", 16, 2)], *ends), tmp_path / "net.onnx")
    return tmp_path / "net.onnx"


def rows(path: Path, name: str, seed: int = 0) -> Path:
    """Record 20 states."""
    np.savez(path, **{name: np.random.default_rng(seed).normal(size=(20, 4)).astype(np.float32)})
    return path


def bundle_from(stage: Source, out: Path) -> Bundle:
    return run_transform(stage, None, out, Context()).bundle


def test_a_policy_directory_is_calibrated_with_what_is_named(bare, tmp_path):
    assert not brings_calibration(source_stage(str(bare)))
    stage = source_stage(str(bare)).with_recordings(RecordingOptions(calibration=str(tmp_path / "calibration.npz")))
    assert brings_calibration(stage)
    carried = calibration_recording(bundle_from(stage, tmp_path / "bundle"))
    with np.load(tmp_path / "calibration.npz") as recorded:
        assert carried is not None
        assert carried.whole is not None  # a half is held out to evaluate on
        np.testing.assert_array_equal(carried.whole.inputs["proprio"], recorded["proprio"])


def test_a_file_that_nobody_described_is_calibrated_and_evaluated_with_what_is_named(onnx_file, tmp_path):
    options = RecordingOptions(
        str(rows(tmp_path / "a.npz", "joints")), str(rows(tmp_path / "b.npz", "joints", 1)), ("state=joints",)
    )
    bundle = bundle_from(source_stage(str(onnx_file)).with_recordings(options), tmp_path / "bundle")
    calibration, (evaluation, _) = calibration_recording(bundle), evaluation_recording(bundle)
    for got, file in ((calibration, "a.npz"), (evaluation, "b.npz")):
        with np.load(tmp_path / file) as recorded:
            assert got is not None
            np.testing.assert_array_equal(got.inputs["state"], recorded["joints"])


def test_recordings_belong_to_the_key_and_to_the_record(onnx_file, tmp_path):
    stages = [source_stage(str(onnx_file)).with_recordings(RecordingOptions(str(rows(tmp_path / "a.npz", "state", at))))
              for at in range(1)]  # fmt: skip
    first = stages[0].key("")
    assert first != source_stage(str(onnx_file)).key("")
    options = bundle_from(stages[0], tmp_path / "bundle").manifest.made_by["options"]
    assert options["calibration"].startswith("a.npz sha256:")
    rows(tmp_path / "a.npz", "state", 5)
    assert stages[0].key("") != first


def test_a_bundle_is_made_again_with_the_recordings_that_were_named(onnx_file, tmp_path):
    stage = source_stage(str(onnx_file)).with_recordings(RecordingOptions(str(rows(tmp_path / "a.npz", "state"))))
    int8 = run_transform(DynamicInt8(), bundle_from(stage, tmp_path / "float"), tmp_path / "int8", Context()).bundle
    shutil.move(tmp_path / "a.npz", (tmp_path / "elsewhere").mkdir() or tmp_path / "elsewhere/a.npz")
    again = rebuild(
        int8, Context(), source=str(onnx_file), files=(tmp_path / "elsewhere/a.npz",), cache=tmp_path / "cache"
    )
    assert again.identical
    with pytest.raises(Exception, match=r"a\.npz"):
        rebuild(int8, Context(), source=str(onnx_file), cache=tmp_path / "cache")


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (RecordingOptions("nowhere.npz"), DataError, "nowhere.npz not found"),
        (RecordingOptions(evaluation="nowhere.npz"), DataError, "nowhere.npz not found"),
        (RecordingOptions(map=("state=joints",)), UsageError, "none is given"),
        (RecordingOptions("net.onnx"), DataError, "unknown format"),
    ],
)
def test_what_is_wrong_is_found_before_anything_runs(onnx_file, monkeypatch, options, error, words):
    monkeypatch.chdir(onnx_file.parent)
    with pytest.raises(error, match=words):
        source_stage(str(onnx_file)).with_recordings(options)


def test_optimize_takes_them_on_its_command_line(onnx_file, tmp_path, capsys):
    recorded = rows(tmp_path / "a.npz", "joints")
    plan = ["optimize", str(onnx_file), "-o", str(tmp_path / "out"), "--dry-run"]
    for more, calibrated in (([], False), (["--calibration", str(recorded), "--map", "state=joints"], True)):
        with pytest.raises(SystemExit) as left:
            main([*plan, *more])
        assert not left.value.code
        assert ("static_int8" in capsys.readouterr().out) == calibrated
