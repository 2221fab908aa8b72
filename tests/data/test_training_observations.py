"""What a training saw calibrates, too: as the graphs take it, checked like everything that comes from outside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests._reach import folder_of
from vlatool.bundle.bundle import Bundle
from vlatool.data import MAX_PLAYED, OBSERVATIONS_FILE, Encoded, kept_rows, played_observations, recorded_observations
from vlatool.errors import DataError
from vlatool.quantize.calibration.activation_statistics import calibrate
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.observation import ObservationEncoder
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.finish import save_npz
from vlatool.stage.record import SampleSet
from vlatool.stage.run import run_transform

QUICK = {"steps": 4, "batch": 16, "episodes": 6, "student_episodes": 2, "every": 2, "threads": 1}


def encoded_rows(bundle: Bundle) -> dict[str, Any]:
    encode = ObservationEncoder(bundle.manifest.spec, bundle)
    rows = [encode(observation) for observation in recorded_observations(bundle, 12)]
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


def test_what_was_written_is_read_and_gives_the_statistics_of_the_raw_observations(
    float_bundle: Bundle, copied: Callable[[Bundle], Bundle], resealed: Callable[[Bundle], Bundle]
):
    bundle = copied(float_bundle)
    assert played_observations(bundle) == []
    save_npz(bundle.path / OBSERVATIONS_FILE, encoded_rows(bundle))
    bundle = resealed(bundle)
    played = played_observations(bundle)
    assert len(played) == 12
    assert all(isinstance(row, Encoded) and len(value) == 1 for row in played for value in row.values())
    values = {"main": StaticInt8().plan(bundle)[1]["main"]}
    raw = calibrate(bundle, values, recorded_observations(bundle, 12), Context())
    again = calibrate(bundle, values, played, Context())
    for name, seen in raw["main"].items():
        assert (seen.low, seen.high) == (again["main"][name].low, again["main"][name].high)


@pytest.mark.parametrize(("most", "row_bytes", "count"), [
    (128, 100, 128), (128, 1 << 20, 64), (128, 100 << 20, 16), (128, 0, 128), (8, 1 << 20, 8),
])  # fmt: skip
def test_large_observations_are_kept_fewer(most: int, row_bytes: int, count: int):
    assert kept_rows(most, row_bytes) == count


@pytest.mark.parametrize(("change", "why"), [
    (lambda rows: rows.pop("proprio"), "it has no 'proprio'"),
    (lambda rows: rows.update(proprio=rows["proprio"][:5]), "different numbers of rows"),
    (lambda rows: rows.update(proprio=rows["proprio"][:, :-1]), r"'proprio' is float32 \(12, \d\); wanted float32"),
    (lambda rows: rows.update(proprio=rows["proprio"].astype(np.float64)), "'proprio' is float64"),
    (lambda rows: rows.update(proprio=rows["proprio"] * np.nan), "'proprio' has values that are not finite"),
])  # fmt: skip
def test_a_wrong_file_is_refused(
    float_bundle: Bundle, copied: Callable[[Bundle], Bundle], resealed: Callable[[Bundle], Bundle], tmp_path: Path,
    change: Callable[[dict[str, Any]], object], why: str,
):  # fmt: skip
    bundle = copied(float_bundle)
    rows = encoded_rows(bundle)
    change(rows)
    save_npz(bundle.path / OBSERVATIONS_FILE, rows)
    with pytest.raises(DataError, match=why):
        run_transform(StaticInt8(), resealed(bundle), tmp_path / "int8", Context())


def test_a_damaged_file_is_refused(
    float_bundle: Bundle, copied: Callable[[Bundle], Bundle], resealed: Callable[[Bundle], Bundle], tmp_path: Path
):
    bundle = copied(float_bundle)
    save_npz(bundle.path / OBSERVATIONS_FILE, encoded_rows(bundle))
    whole = (bundle.path / OBSERVATIONS_FILE).read_bytes()
    (bundle.path / OBSERVATIONS_FILE).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"played\.npz"):
        run_transform(StaticInt8(), resealed(bundle), tmp_path / "int8", Context())


def ranges_of(bundle: Bundle) -> dict[str, tuple[float, float]]:
    stage = StaticInt8()
    _, values = stage.plan(bundle)
    found = stage.statistics(bundle, values, SampleSet(), Context())["main"]
    return {name: (seen.low, seen.high) for name, seen in found.items()}


def trained(folder: Path, stage: str, tmp_path: Path) -> Bundle:
    source = run_transform(TorchModule(policy=folder), None, tmp_path / "source", Context()).bundle
    tuned = run_transform(build_stage(stage, QUICK), source, tmp_path / "tuned", Context()).bundle
    return run_transform(build_stage("export.onnx", {}), tuned, tmp_path / "exported", Context()).bundle


def test_ranges_cover_what_the_training_saw_and_the_recording_did_not(tmp_path: Path):
    folder = folder_of(tmp_path / "policy")
    near = np.random.default_rng(0).normal(size=(32, 4)).astype(np.float32) * 0.01
    np.savez(folder / "calibration.npz", state=near)
    exported = trained(folder, "quantize.qat", tmp_path)
    played = np.concatenate([row["state"] for row in played_observations(exported)])
    assert len(played) == MAX_PLAYED
    (name,) = ranges_of(exported)
    low, high = ranges_of(exported)[name]
    assert (low, high) == (pytest.approx(min(played.min(), 0)), pytest.approx(played.max()))
    assert high > 10 * np.abs(near).max(), "episodes go farther than what was recorded"
    int8 = run_transform(StaticInt8(), exported, tmp_path / "int8", Context()).bundle
    assert int8.manifest.made_by["calibration"]["samples"] == 16 + MAX_PLAYED, "half of a recording is held out"


@pytest.mark.soak("observations of one training: test_ranges_cover_what_the_training_saw_and_the_recording_did_not")
def test_an_input_may_be_called_as_it_likes_and_a_second_training_keeps_its_own(tmp_path: Path):
    folder = folder_of(tmp_path / "policy")
    for name in ("policy.yaml", "policy.py", "environment.py"):
        text = (folder / name).read_text()
        (folder / name).write_text(text.replace("name: state", "name: file").replace('"state"', '"file"')
                                   .replace("def forward(self, state)", "def forward(self, file)")
                                   .replace("(state)", "(file)").replace("state[", "file["))  # fmt: skip
    source = run_transform(TorchModule(policy=folder), None, tmp_path / "source", Context()).bundle
    once = run_transform(build_stage("quantize.qat", QUICK), source, tmp_path / "once", Context()).bundle
    before = (once.path / OBSERVATIONS_FILE).read_bytes()
    other = {**QUICK, "first_seed": 2_000_000}
    twice = run_transform(build_stage("quantize.qat", other), once, tmp_path / "twice", Context()).bundle
    assert [set(bundle) for bundle in played_observations(twice)[:1]] == [{"file"}]
    assert (once.path / OBSERVATIONS_FILE).read_bytes() == before != (twice.path / OBSERVATIONS_FILE).read_bytes()


def test_a_policy_without_recordings_calibrates_on_its_training(tmp_path: Path):
    exported = trained(folder_of(tmp_path / "policy"), "quantize.qat", tmp_path)
    StaticInt8().check(exported, None)
    int8 = run_transform(StaticInt8(), exported, tmp_path / "int8", Context()).bundle
    assert int8.manifest.made_by["calibration"]["samples"] == MAX_PLAYED
    with pytest.raises(DataError, match="carries no calibration data") as told:
        run_transform(build_stage("quantize.smooth_quant", {}), exported, tmp_path / "smooth", Context())
    assert "qat" not in told.value.fix, "it would not help"


def test_who_has_an_environment_alone_is_told_of_qat(tmp_path: Path):
    source = run_transform(
        TorchModule(policy=folder_of(tmp_path / "policy")), None, tmp_path / "source", Context()
    ).bundle
    exported = run_transform(build_stage("export.onnx", {}), source, tmp_path / "exported", Context()).bundle
    with pytest.raises(DataError, match=r"^reach carries no calibration data") as told:
        StaticInt8().check(exported, None)
    assert told.value.fix.endswith(", or quantize.qat, which plays episodes")
