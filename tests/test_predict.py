import math

import pytest

from vlatool.predict import predictions
from vlatool.profile import load_profile, names


@pytest.mark.parametrize("name", names())
@pytest.mark.parametrize("kind", ["float_bundle", "int8_bundle"])
def test_every_board_gets_latency_and_memory_as_predictions_for_that_board(name, kind, request):
    found = {each.name: each for each in predictions(load_profile(name), request.getfixturevalue(kind))}
    assert set(found) == {"latency_p50", "memory"}
    for each in found.values():
        assert (each.origin, each.where, each.samples) == ("predicted", name, 0)
        assert each.note
        if each.known:
            assert each.low is not None
            assert each.high is not None
            assert 0 < each.low < each.value < each.high


def test_a_quantized_convolution_and_its_uint8_image_can_be_predicted(int8_bundle):
    latency, _ = predictions(load_profile("raspberry-pi-5"), int8_bundle)
    assert latency.known, latency.note


def test_without_ground_the_prediction_is_not_a_number_and_says_why(float_bundle):
    board = load_profile("raspberry-pi-5")
    blind = board.engines["ort_cpu"].model_copy(update={"efficiency": {}})
    found, _ = predictions(board.model_copy(update={"engines": {"ort_cpu": blind}}), float_bundle)
    assert math.isnan(found.value)
    assert "no published latencies in float32" in found.note
