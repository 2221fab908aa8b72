from __future__ import annotations

import math

import pytest

from vlatool.errors import ProfileError
from vlatool.hwselect._roofline import predict, predict_memory
from vlatool.hwselect._workload import GraphWorkload, Workload
from vlatool.profile import load_profile

ORIN = load_profile("jetson-orin-nano")
NUC = load_profile("intel-nuc-13-pro")
PI = load_profile("raspberry-pi-5")


def work(dtype: str, gmacs: float, weights_mb: float = 0, layers: int = 0, **options: object) -> Workload:
    graph = GraphWorkload({dtype: int(gmacs * 1e9)}, layers, int(weights_mb * 1e6), **options)  # type: ignore[arg-type]
    return Workload({"main": graph}, {"main": 1})


def test_the_formula_where_compute_binds() -> None:
    found = predict(PI, work("float32", 1.0, layers=10))
    assert found.value == pytest.approx(2e9 / (0.1536e12 * 0.33) * 1e3 + 10 * 0.037)
    assert (found.name, found.unit, found.origin, found.where) == ("latency_p50", "ms", "predicted", "raspberry-pi-5")
    assert found.samples == 0
    assert found.low == pytest.approx(found.value / 1.8)
    assert found.high == pytest.approx(found.value / 0.2)
    assert found.confidence == 0.9
    for word in ("ort_cpu", "roofline", "80%", "default"):
        assert word in found.note


def test_the_formula_where_memory_binds() -> None:
    found = predict(PI, work("float32", 0.001, weights_mb=100))
    assert found.value == pytest.approx(100e6 / (17.1e9 * 0.11) * 1e3)


def test_estimated_figures_widen_the_interval() -> None:
    found = predict(PI, work("int8", 1.0))
    assert found.high == pytest.approx(found.value / 0.11)
    assert "89%" in found.note
    assert "outside the fit" in predict(NUC, work("float32", 1.0)).note


def test_power_modes_scale_compute_and_bandwidth() -> None:
    assert "25W" in predict(ORIN, work("float16", 30.0)).note
    fast, slow = (predict(ORIN, work("float16", 30.0), mode=mode).value for mode in ("MAXN_SUPER", "7W"))
    assert slow / fast == pytest.approx((8 * 1020) / (4 * 408))
    fast, slow = (predict(ORIN, work("float16", 0.001, 1000), mode=mode).value for mode in ("MAXN_SUPER", "7W"))
    assert slow / fast == pytest.approx(102 / 68)


@pytest.mark.parametrize(
    ("dtype", "size", "published_ms"), [("float32", 4, 27.9), ("float16", 2, 13.5), ("int8", 1, 9.1)]
)
def test_published_latencies_on_orin_nano(dtype: str, size: int, published_ms: float) -> None:
    """YOLO11m (34 GMACs, 20.1 M parameters) in TensorRT at MAXN_SUPER; see the profile's sources."""
    found = predict(ORIN, work(dtype, 34.0, 20.1 * size, 100, activation_bytes=25_000_000 * size), mode="MAXN_SUPER")
    assert found.value == pytest.approx(published_ms, rel=0.25)


@pytest.mark.parametrize(("gmacs", "params", "layers", "published_ms"), [(4.108, 25.5, 54, 5.0), (11.2, 85, 74, 23.8)])
def test_published_latencies_on_nuc(gmacs: float, params: float, layers: int, published_ms: float) -> None:
    """ResNet-50 and BERT base in OpenVINO int8 on the processor; see the profile's sources."""
    found = predict(NUC, work("int8", gmacs, params, layers), "openvino")
    assert found.low is not None
    assert found.high is not None
    assert found.low < published_ms < found.high
    assert found.value == pytest.approx(published_ms, rel=0.4)


def test_graphs_are_predicted_apart_and_repeated() -> None:
    compute = GraphWorkload({"float32": 10**9})
    memory = GraphWorkload({"float32": 1}, weight_bytes=10**8)
    both = predict(PI, Workload({"a": compute, "b": memory}, {"a": 1, "b": 10})).value
    apart = (
        predict(PI, Workload({"a": compute}, {"a": 1})).value
        + 10 * predict(PI, Workload({"b": memory}, {"b": 1})).value
    )
    assert both == pytest.approx(apart)
    idle = Workload({"a": compute, "nothing": GraphWorkload()}, {"a": 1, "nothing": 1})
    assert predict(PI, idle).value == pytest.approx(predict(PI, Workload({"a": compute}, {"a": 1})).value)


def test_mixed_precision_adds_up() -> None:
    mixed = Workload({"m": GraphWorkload({"int8": 10**9, "float32": 10**9})}, {"m": 1})
    expected = 2e9 / (4.45e12 * 0.30) + 2e9 / (1.11e12 * 0.26)
    assert predict(NUC, mixed).value == pytest.approx(expected * 1e3)


@pytest.mark.parametrize(
    ("load", "engine", "reason"),
    [
        (work("int4", 1.0), "ort_tensorrt", "no published latencies in int4"),
        (work("int8", 1.0), "ort_cuda", "no published latencies in int8"),
        (work("int8", 1.0, integer_ops=True), "ort_tensorrt", "uses integer operators"),
        (work("int8", 1.0, unknown=("proj",)), "ort_tensorrt", "1 layers have no static shape, for example main/proj"),
        (Workload({}, {}), "ort_tensorrt", "no matrix product"),
    ],
)
def test_no_number_without_ground(load: Workload, engine: str, reason: str) -> None:
    found = predict(ORIN, load, engine)
    assert math.isnan(found.value)
    assert not found.known
    assert found.low is None
    assert found.high is None
    assert reason in found.note
    assert found.origin == "predicted"


def test_unknown_engine_and_mode() -> None:
    with pytest.raises(ProfileError, match="has no engine 'tensorrt'"):
        predict(ORIN, work("int8", 1.0), "tensorrt")
    with pytest.raises(ProfileError, match="has no power mode"):
        predict(ORIN, work("int8", 1.0), mode="20W")
    with pytest.raises(ProfileError, match="has no engine"):
        predict_memory(PI, work("int8", 1.0), "openvino")


def test_memory_is_compared_with_what_is_usable() -> None:
    found = predict_memory(PI, work("float32", 1.0, weights_mb=100, peak_bytes=20_000_000))
    assert found.value == pytest.approx(54 + 100 + 20)
    assert (found.name, found.unit, found.origin, found.where) == ("memory", "MB", "predicted", "raspberry-pi-5")
    assert found.low == pytest.approx(174 * 0.8)
    assert found.high == pytest.approx(174 * 2)
    assert "fits into the 7000 MB" in found.note
    assert "may not fit into" in predict_memory(PI, work("float32", 1.0, 5000)).note
    assert "does not fit into" in predict_memory(PI, work("float32", 1.0, 10000)).note


def test_memory_of_an_unknown_graph_is_unknown() -> None:
    assert not predict_memory(PI, work("int8", 1.0, unknown=("proj",))).known
