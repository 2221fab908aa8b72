import json
import math

import pytest

from vlatool.hardware.profile import load_profile, profile_names
from vlatool.latency_model.board_measurements import BoardMeasurement, store
from vlatool.latency_model.predict import predictions


@pytest.mark.parametrize("name", profile_names())
@pytest.mark.parametrize("kind", ["float_bundle", "int8_bundle"])
def test_every_board_gets_latency_memory_and_energy_as_predictions_for_that_board(name, kind, request):
    found = {each.name: each for each in predictions(load_profile(name), request.getfixturevalue(kind))}
    assert set(found) == {"latency_p50", "memory"} | ({"energy"} if found["latency_p50"].known else set())
    for each in found.values():
        assert (each.origin, each.where, each.samples) == ("predicted", name, 0)
        assert each.confidence == 0.8
        assert each.note
        if each.known:
            assert each.low is not None
            assert each.high is not None
            assert 0 < each.low <= each.value <= each.high
        else:
            assert (each.low, each.high) == (None, None)


def test_a_small_policy_on_a_processor_can_be_predicted(float_bundle):
    latency, memory, energy = predictions(load_profile("raspberry-pi-5"), float_bundle)
    assert latency.known, latency.note
    assert latency.value < 100, "a tiny policy takes milliseconds at most"
    assert 54 < memory.value < 200
    assert energy.value == pytest.approx(0.65 * load_profile("raspberry-pi-5").power_w.value * latency.value / 1e3)


def test_without_ground_the_prediction_is_not_a_number_and_says_why(float_bundle):
    board = load_profile("raspberry-pi-5")
    blind = board.engines["ort_cpu"].model_copy(update={"runtime": ""})
    found, *_ = predictions(board.model_copy(update={"engines": {"ort_cpu": blind}}), float_bundle)
    assert math.isnan(found.value)
    assert found.note == "no latency was published for ort_cpu"


def test_what_was_measured_on_the_board_decides(float_bundle, monkeypatch, tmp_path):
    monkeypatch.setenv("VLATOOL_CALIBRATIONS", str(tmp_path))
    board = load_profile("raspberry-pi-5")
    before, *_ = predictions(board, float_bundle)
    work = {"macs": 3e5, "weights": 5e3, "activations": 2e3, "layers": 10, "traits": ["attention"]}
    store([BoardMeasurement(board.name, board.default_mode, board.engine, "float32", work, 4 * before.value)])
    after, *_ = predictions(board, float_bundle)
    assert "from other devices, runtimes or precisions" in before.note
    assert after.note.startswith("ort_cpu, power mode default: with your own measurement on this device")
    assert after.value > 1.5 * before.value
    assert json.loads((tmp_path / "raspberry-pi-5.json").read_text())["measured"][0]["work"] == work


def test_a_bundle_is_predicted_in_an_engine_that_runs_it(float_bundle, int8_bundle):
    """ONNX Runtime's integer products do not run in TensorRT, which the board prefers."""
    board = load_profile("jetson-orin-nano")
    notes = [predictions(board, bundle)[0].note for bundle in (float_bundle, int8_bundle)]
    assert board.engine == "ort_tensorrt"
    assert notes[0].startswith("ort_tensorrt")
    assert notes[1].startswith("ort_cpu")


def test_what_no_engine_runs_is_not_predicted(int8_bundle):
    board = load_profile("jetson-orin-nano")
    alone = board.model_copy(update={"engines": {"ort_tensorrt": board.engines["ort_tensorrt"]}})
    found, *_ = predictions(alone, int8_bundle)
    assert math.isnan(found.value)
    assert found.note == "no engine of jetson-orin-nano runs this bundle, whose graphs are int8"
