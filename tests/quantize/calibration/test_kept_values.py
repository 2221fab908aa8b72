"""Ranges of a policy that keeps values: of what is kept along whole episodes, as on a robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from _full import small_or_full
from _recurrent import LENGTH, exported, recorded

from vlatool.bundle.bundle import Bundle
from vlatool.data import calibration_recording
from vlatool.quantize.calibration.activation_statistics import calibrate
from vlatool.quantize.calibration.samples import recorded_moments, samples_with_state
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.streamed import sequential_calibration
from vlatool.quantize.weight_only import WeightOnly
from vlatool.stage.base import Context, Transform
from vlatool.stage.record import SampleSet
from vlatool.stage.run import run_transform

pytestmark = pytest.mark.filterwarnings("ignore:.*calibration samples:UserWarning")


def ones(path: Path, episodes: int, *, borders: bool = True) -> Path:
    """Write a recording whose sum at each step is the number of the step in its episode."""
    rows = recorded(episodes, episodes=borders)
    np.savez(path, **{**rows, "target": np.ones_like(rows["target"])})
    return path


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A policy that adds up, exported; read only."""
    return exported(tmp_path_factory.mktemp("sum") / "sum", "sum", count=0)


@pytest.mark.parametrize("samples", [1000, 5, 2])
def test_values_are_carried_along_an_episode_and_forgotten_at_its_end(added: Bundle, tmp_path: Path, samples: int):
    stage = StaticInt8(calibration=ones(tmp_path / "ones.npz", 9), samples=samples)
    found = stage.statistics(added, {"main": ["memory"]}, SampleSet(), Context())["main"]["memory"]
    assert found.high == LENGTH - 1, "before the last step of an episode"
    assert found.samples <= 2 * min(samples, 9 * LENGTH), "what leads to a sample does not count"


def test_only_what_was_asked_for_is_looked_at(added: Bundle, tmp_path: Path):
    recording = calibration_recording(added, ones(tmp_path / "ones.npz", 3))
    seen = SampleSet()
    moments = recorded_moments(added, recording, [4, LENGTH + 7], seen)
    found = calibrate(added, {"main": ["memory"]}, moments, Context())["main"]["memory"]
    assert (found.low, found.high) == (4, 7)
    assert seen.record()["samples"] == 2


def test_half_of_a_recording_without_episodes_is_led_to_by_the_other_half(tmp_path: Path):
    """What is held out of the calibration went by all the same."""
    folder = tmp_path / "sum"
    bundle = exported(folder, "sum", count=4, episodes=False)
    whole = ones(tmp_path / "ones.npz", 4, borders=False)
    recording = calibration_recording(bundle)
    assert len(recording) == 2 * LENGTH, "the half that is not held out"
    (bundle.path / "data/calibration.npz").unlink()
    (bundle.path / "data/calibration.npz").write_bytes(whole.read_bytes())
    found = StaticInt8().statistics(bundle, {"main": ["memory"]}, SampleSet(), Context())["main"]["memory"]
    assert found.high == 4 * LENGTH - 1 - LENGTH // 2, "the last stretch of eight is held out"


def test_weights_are_rounded_by_what_layers_are_given_along_an_episode(tmp_path: Path):
    """Each layer of the sum is given what is kept; the samples of a product say which."""
    bundle = exported(tmp_path / "sum", "sum", count=0)
    recording = calibration_recording(bundle, ones(tmp_path / "ones.npz", 2))
    moments = recorded_moments(bundle, recording, [0, 3, LENGTH, 2 * LENGTH - 1], SampleSet())
    kept = [values["memory"].tolist() for _, values in samples_with_state(bundle, moments)]
    assert kept == [[[0, 0]], [[3, 3]], [[0, 0]], [[LENGTH - 1, LENGTH - 1]]]


def test_gptq_gives_layers_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen = []
    real = sequential_calibration.gptq

    def gptq(weight, rows, *rest):
        seen.append(rows.copy())
        return real(weight, rows, *rest)

    monkeypatch.setattr(sequential_calibration, "gptq", gptq)
    bundle = exported(tmp_path / "sum", "sum", count=0)
    stage = WeightOnly(method="gptq", calibration=ones(tmp_path / "ones.npz", 2), samples=2 * LENGTH, exclude=())
    (tmp_path / "out").mkdir()
    stage.run(bundle, tmp_path / "out", Context())
    assert np.concatenate(seen).reshape(-1, 2)[:, 0].tolist() == 2 * list(range(1, LENGTH + 1))


@pytest.mark.parametrize("stage", [StaticInt8(), *small_or_full([], [DynamicInt8()])])
def test_a_recurrent_layer_that_stays_float32_is_named(tmp_path: Path, stage: Transform):
    """ONNX has one operator for nn.GRU, and none that multiplies its weights in int8."""
    said = {}
    for kind in ("gru", "elman"):
        bundle = exported(tmp_path / kind, kind, count=2)
        result = run_transform(stage, bundle, tmp_path / f"{kind}-int8", Context())
        said[kind] = [line for line in result.messages if "recurrent layer" in line]
        assert (result.bundle.manifest.graphs["main"].precision.get("float32", 0) > 0.5) is (kind == "gru")
    assert "gru/GRU, gru/GRU_1 computed in float32" in said["gru"][0]
    assert not said["elman"]
