from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from vlatool.errors import ProfileError
from vlatool.graph.workload import PRECISIONS, GraphWorkload, Workload, stored_precision
from vlatool.hardware.profile import Profile, load_profile, profile_names
from vlatool.latency_model.board import (
    BUSY,
    Candidate,
    Outcome,
    candidates,
    compute_unit_of,
    idle_watts,
    memory_mb,
    outcomes,
    power_limit,
    rescale,
    stored_quantization,
    watts,
    weight_bytes,
    work_of,
)
from vlatool.latency_model.features import Shares, roofline_parts
from vlatool.latency_model.model import LatencyModel
from vlatool.latency_model.published_latencies import known_devices

Load = Callable[..., Workload]
PI = load_profile("raspberry-pi-5")
ORIN = load_profile("jetson-orin-nano")
HAILO = load_profile("raspberry-pi-5-hailo8")


def one(
    model: LatencyModel, work: Workload, board: Profile = PI, mode: str = "", engine: str = "", **how: str
) -> Outcome:
    """The outcome of one way."""
    return outcomes([Candidate(board, mode or board.default_mode, engine or board.engine, **how)], work, model)[0]


def test_a_float_bundle_may_be_driven_in_every_way(load: Load) -> None:
    found = candidates(ORIN, load())
    assert len(found) == len(ORIN.modes) * sum(len(engine.dtypes) for engine in ORIN.engines.values())
    assert (found[0].engine, found[0].precision) == ("ort_tensorrt", "int8")
    assert {way.mode for way in candidates(ORIN, load(), ["7W"])} == {"7W"}
    assert all(way.precision in way.figures.dtypes for way in found)


def test_a_quantized_bundle_goes_to_engines_that_run_it(load: Load) -> None:
    def offered(work: Workload) -> set[str]:
        found = candidates(ORIN, work, ["25W"])
        assert {way.precision for way in found} <= {""}
        return {way.engine for way in found}

    assert offered(load(precision="int8")) == {"ort_tensorrt", "ort_cpu"}
    assert offered(load(precision="int8", integer_ops=True)) == {"ort_cpu"}, "TensorRT has no integer operators"
    assert offered(load(precision="float16")) == {"ort_tensorrt", "ort_cuda"}
    assert offered(load(precision="int4")) == {"ort_cuda", "ort_cpu"}
    assert offered(load(precision="float8")) == set()


@pytest.mark.parametrize(
    ("macs", "precision"),
    [({"float32": 9}, "float32"), ({"float32": 1, "int8": 9}, "int8"), ({"int4": 9}, "w4"), ({"uint8": 9}, "int8"),
     ({"float4": 9}, "float8"), ({"float64": 9}, "float32"), ({}, "float32")],
)  # fmt: skip
def test_a_graph_has_the_precision_of_most_of_it(macs: dict[str, int], precision: str) -> None:
    assert stored_precision(GraphWorkload(macs)) == precision


def test_a_bundle_has_the_precision_of_its_largest_graph() -> None:
    graphs = {"small": GraphWorkload({"float32": 10}), "large": GraphWorkload({"int8": 90})}
    assert stored_quantization(Workload(graphs, {"small": 1, "large": 1})) == "int8"
    assert stored_quantization(Workload(graphs, {"small": 100, "large": 1})) == "float32"
    assert stored_quantization(Workload({"small": graphs["small"]}, {"small": 1})) == ""


def test_a_place_has_the_clocks_of_its_mode() -> None:
    fast, slow = (compute_unit_of(Candidate(ORIN, mode, "ort_tensorrt", "int8")) for mode in ("MAXN_SUPER", "7W"))
    assert (fast.device, fast.unit) == ("jetson-orin-nano-8gb-super", "gpu"), "named as in the published figures"
    assert (fast.cores, slow.cores) == (8, 4)
    assert (fast.clock_ghz, slow.clock_ghz) == (1.02, 0.408)
    assert slow.peaks["int8"] == pytest.approx(33.4 * 4 / 8 * 408 / 1020)
    assert (fast.bandwidth_gb_s, slow.bandwidth_gb_s) == (102, 68)
    assert slow.setting == "7W"


def test_a_place_has_the_instruction_set_of_its_unit() -> None:
    assert compute_unit_of(Candidate(ORIN, "7W", "ort_tensorrt", "int8")).isa == "sm_87"
    assert compute_unit_of(Candidate(PI, "default", "ort_cpu", "int8")).isa == "asimd asimdhp asimddp"


def test_a_unit_with_its_own_way_to_memory_has_its_bandwidth() -> None:
    narrow = PI.units["cpu"].model_copy(update={"bandwidth_gb_s": PI.bandwidth_gb_s.model_copy(update={"value": 3.0})})
    board = PI.model_copy(update={"units": {"cpu": narrow}})
    assert compute_unit_of(Candidate(board, "default", "ort_cpu", "int8")).bandwidth_gb_s == 3.0
    assert compute_unit_of(Candidate(PI, "default", "ort_cpu", "int8")).bandwidth_gb_s == 17.1


def test_a_hailo_hangs_on_a_narrow_bus() -> None:
    """The accelerator reaches the memory of the Pi through PCI Express, whatever the memory's own bandwidth."""
    place = compute_unit_of(Candidate(HAILO, "default", "hailort", "int8"))
    assert place.bandwidth_gb_s <= known_devices()["hailo-8", "npu"].bandwidth_gb_s


def test_one_processor_is_one_device_whatever_is_plugged_in() -> None:
    plain, beside = (compute_unit_of(Candidate(board, "default", "ort_cpu", "int8")) for board in (PI, HAILO))
    assert beside.device == plain.device == "raspberry-pi-5"


def test_an_integrated_gpu_is_asked_about_as_one() -> None:
    nuc = load_profile("intel-nuc-13-pro")
    place = compute_unit_of(Candidate(nuc, nuc.default_mode, "openvino_gpu", "int8"))
    assert (place.device, place.unit) == ("i7-1360p", "igpu")


def test_unknown_engines_and_modes_are_refused(load: Load) -> None:
    with pytest.raises(ProfileError, match="has no engine 'tensorrt'; did you mean 'ort_tensorrt'"):
        _ = Candidate(ORIN, "25W", "tensorrt").figures
    with pytest.raises(ProfileError, match="has no power mode '20W'"):
        compute_unit_of(Candidate(ORIN, "20W", "ort_tensorrt"))
    with pytest.raises(ProfileError, match="has no power mode '20W'"):
        watts(Candidate(ORIN, "20W", "ort_tensorrt"))


# ---- latency


def test_graphs_and_their_repeats_add_up(certain: LatencyModel, load: Load) -> None:
    single = one(certain, load(), precision="float32").latency
    graph = load().graphs["main"]
    twice = one(certain, Workload({"a": graph, "b": graph}, {"a": 1, "b": 10}), precision="float32")
    assert twice.latency.ms == pytest.approx(11 * single.ms)
    assert twice.latency.high == pytest.approx(11 * single.high)
    assert [(phase.name, phase.runs) for phase in twice.phases] == [("a", 1), ("b", 10)]
    assert twice.phases[1].ms == pytest.approx(10 * single.ms)


def test_a_graph_without_layers_costs_nothing(certain: LatencyModel, load: Load) -> None:
    graph = load().graphs["main"]
    found = one(certain, Workload({"a": graph, "idle": GraphWorkload()}, {"a": 1, "idle": 1}), precision="float32")
    assert found.latency.ms == pytest.approx(one(certain, load(), precision="float32").latency.ms)
    assert [phase.name for phase in found.phases] == ["a"]


def test_many_ways_are_answered_as_one_by_one(certain: LatencyModel, load: Load) -> None:
    ways = candidates(ORIN, load())
    for way, found in zip(ways, outcomes(ways, load(), certain), strict=True):
        alone = outcomes([way], load(), certain)[0]
        assert found.candidate is way
        assert found.latency.why == alone.latency.why
        assert found.latency.ms == pytest.approx(alone.latency.ms, nan_ok=True)


@pytest.mark.parametrize(
    ("work", "engine", "why"),
    [
        (Workload({"m": GraphWorkload({}, 2, unknown=("proj", "out"))}, {"m": 1}), "ort_cpu",
         "2 layers have no static shape, for example m/proj"),
        (Workload({}, {}), "ort_cpu", "the graphs have no matrix product or convolution to count"),
        (Workload({"m": GraphWorkload()}, {"m": 1}), "ort_cpu", "the graphs have no matrix product"),
    ],
    ids=["no-shapes", "no-graph", "no-layer"],
)  # fmt: skip
def test_without_ground_there_is_a_reason(certain: LatencyModel, work: Workload, engine: str, why: str) -> None:
    found = one(certain, work, engine=engine, precision="float32")
    assert math.isnan(found.latency.ms)
    assert math.isnan(found.joules)
    assert why in found.latency.why


def test_an_engine_without_published_latencies_is_unknown(certain: LatencyModel, load: Load) -> None:
    blind = PI.model_copy(update={"engines": {"ort_cpu": PI.engines["ort_cpu"].model_copy(update={"runtime": ""})}})
    assert one(certain, load(), blind, precision="int8").latency.why == "no latency was published for ort_cpu"


def test_one_unknown_phase_makes_the_whole_unknown(certain: LatencyModel, load: Load) -> None:
    graph = load().graphs["main"]
    both = Workload({"a": graph, "b": replace(graph, traits=frozenset({"attention"}))}, {"a": 1, "b": 1})
    found = one(certain, both, HAILO, engine="hailort", precision="int8")
    assert not found.latency.known
    assert "Hailo" in found.latency.why


@pytest.mark.parametrize("precision", ["", "float32"])
def test_what_an_npu_does_not_compute_in_is_unknown_not_a_crash(
    certain: LatencyModel, load: Load, precision: str
) -> None:
    assert (
        "does not compute in float32" in one(certain, load(), HAILO, engine="hailort", precision=precision).latency.why
    )


def test_a_bundle_with_one_float_graph_is_unknown_on_an_npu(certain: LatencyModel, load: Load) -> None:
    graphs = {"large": load(precision="int8").graphs["main"], "small": load(gmacs=0.01).graphs["main"]}
    work = Workload(graphs, {"large": 1, "small": 1})
    found = {each.candidate.engine: each for each in outcomes(candidates(HAILO, work), work, certain)}
    assert not found["hailort"].latency.known


@pytest.mark.parametrize("name", profile_names())
def test_no_prediction_is_faster_than_the_peaks(certain: LatencyModel, load: Load, name: str) -> None:
    work = load(gmacs=400.0, weights_m=2000.0)
    asked = candidates(load_profile(name), work)
    for found in outcomes(asked, work, certain):
        if found.latency.known:
            parts = roofline_parts(found.phases[0].question, Shares(**dict.fromkeys(vars(Shares()), 1.0)))
            least = max(parts["compute"], parts["memory"])
            assert min(found.latency.low, found.latency.ms, found.latency.high) >= least * (1 - 1e-9)


# ---- memory


def test_memory_is_base_and_weights_and_live_tensors(load: Load) -> None:
    middle, low, high = memory_mb(Candidate(PI, "default", "ort_cpu", "float32"), load())
    base, weights, live = 54, 11.7e6 * 4 / 1e6, 5.0
    assert low == pytest.approx(base + weights + live)
    assert middle == pytest.approx(base + 1.3 * weights + 3 * live + 15)
    assert high == pytest.approx(base + 2 * weights + 5 * live + 40)


@pytest.mark.parametrize(("precision", "size"), [(name, sizes[0]) for name, sizes in PRECISIONS.items()])
def test_weights_take_the_bytes_of_their_precision(load: Load, precision: str, size: float) -> None:
    assert weight_bytes(load(), precision) == pytest.approx(11.7e6 * size)


def test_tables_that_are_looked_up_keep_sixteen_bits() -> None:
    graph = GraphWorkload({"float32": 10}, 1, weights=1000, weight_bytes=4 * 5000)
    work = Workload({"m": graph}, {"m": 1})
    assert weight_bytes(work, "int8") == 1000 + 4000 * 2
    assert weight_bytes(work, "float32") == 4 * 5000
    assert weight_bytes(work, "") == 4 * 5000


# ---- power


def test_power_is_a_share_of_the_modes_limit(certain: LatencyModel, load: Load) -> None:
    way = Candidate(ORIN, "15W", "ort_tensorrt", "int8")
    assert power_limit(way) == 15
    assert watts(way) == pytest.approx((0.65 * 15, 0.45 * 15, 0.95 * 15))
    assert power_limit(replace(way, mode="MAXN_SUPER")) == ORIN.power_w.value, "a mode without a budget"
    found = outcomes([way], load(), certain)[0]
    assert found.joules == pytest.approx(BUSY * 15 * found.latency.ms / 1e3)


def test_idle_power_is_known_or_a_share_and_never_above_the_busy_one() -> None:
    assert idle_watts(Candidate(ORIN, "25W", "ort_cpu")) == 4.3
    assert idle_watts(Candidate(ORIN, "7W", "ort_cpu")) == pytest.approx(0.45 * 7)
    assert ORIN.idle_w
    bare = ORIN.model_copy(update={"idle_w": None})
    assert idle_watts(Candidate(bare, "25W", "ort_cpu")) == pytest.approx(0.3 * 25)


def test_a_board_that_is_asked_rarely_draws_less(certain: LatencyModel, load: Load) -> None:
    found = one(certain, load(), ORIN, precision="float16")
    busy = 10 * found.latency.ms / 1e3
    assert busy < 1
    assert found.average_watts(10) == pytest.approx(4.3 + (found.watts[0] - 4.3) * busy)
    assert found.average_watts(1e9) == pytest.approx(found.watts[0])


# ---- changes of a workload


def test_a_workload_is_scaled_graph_by_graph(load: Load) -> None:
    graph = load().graphs["main"]
    work = Workload({"a": graph, "b": graph}, {"a": 1, "b": 10})
    found = rescale(work, {"a": (0.5, 0.25, 0.1)}, {"b": 5})
    assert found.runs == {"a": 1, "b": 5}
    assert found.graphs["b"] == graph
    changed = found.graphs["a"]
    assert changed.macs == {"float32": 900_000_000}
    assert (changed.weights, changed.weight_bytes) == (11_700_000 // 4, 46_800_000 // 4)
    assert (changed.activations, changed.activation_bytes, changed.peak_bytes) == (250_000, 1_000_000, 500_000)
    assert work_of(changed).macs == 9e8
