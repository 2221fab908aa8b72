from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from vlatool.errors import DataError
from vlatool.hardware.profile import load_profile
from vlatool.latency_model.published_latencies import (
    Point,
    known_devices,
    merge_versions,
    model_family,
    published_devices,
    read_points,
)

Rows = list[dict[str, str]]
Written = Callable[[Rows], Path]


@pytest.fixture
def one(published: Rows, points_at: Written) -> Callable[..., Point]:
    """Read the first row with some columns changed."""

    def read(**changes: str) -> Point:
        return read_points(points_at([published[0] | changes]))[0]

    return read


@pytest.fixture
def told(published: Rows, points_at: Written) -> Callable[..., str]:
    """What is said of the third line with some columns changed."""

    def read(**changes: str) -> str:
        with pytest.raises(DataError) as caught:
            read_points(points_at([published[0], published[1] | changes]))
        return caught.value.message

    return read


def test_every_row_becomes_a_question(points_file: Path, published: Rows) -> None:
    found = read_points(points_file)
    assert len(found) == 60
    assert not [point.why for point in found if point.question is None]
    for point, row in zip(found, published, strict=True):
        assert point.log_ms == pytest.approx(math.log(float(row["value"])))
        assert (point.group, point.kind, point.model) == (
            row["device"].lower(),
            row["device_class"],
            model_family(row["model"]),
        )


def test_a_row_says_the_work(one: Callable[..., Point]) -> None:
    question = one().question
    assert question is not None
    work = question.work
    assert (work.macs, work.weights, work.activations, work.layers) == (1.8e9, 11.7e6, 2.5e6, 21)
    assert (question.runtime, question.precision, question.compute_unit.device) == (
        "ncnn-cpu",
        "float32",
        "raspberry-pi-4",
    )


@pytest.mark.parametrize(
    ("metric", "value", "ms"), [("latency_ms", "20", 20.0), ("fps", "20", 50.0), ("tokens_per_s", "20", 50.0)]
)
def test_every_metric_becomes_milliseconds(one: Callable[..., Point], metric: str, value: str, ms: float) -> None:
    assert one(metric=metric, value=value).log_ms == pytest.approx(math.log(ms))


def test_a_decoded_token_reads_each_weight_once(one: Callable[..., Point]) -> None:
    question = one(metric="tokens_per_s", precision="int8", model="llama-3").question
    assert question is not None
    assert question.work.macs == pytest.approx(question.work.weights)
    assert question.work.weights == pytest.approx(11.7e6)
    assert {"dense", "attention"} <= question.work.traits
    assert question.precision == "w8"


@pytest.mark.parametrize(
    ("batch", "metric", "runtime"),
    [("1", "fps", "ncnn-cpu"), ("throughput", "fps", "ncnn-cpu, streams"), ("offline", "fps", "ncnn-cpu, streams"),
     ("8", "fps", "ncnn-cpu, batch 8"), ("8", "latency_ms", "ncnn-cpu")],
)  # fmt: skip
def test_throughput_is_a_runtime_of_its_own(one: Callable[..., Point], batch: str, metric: str, runtime: str) -> None:
    question = one(batch=batch, metric=metric).question
    assert question is not None
    assert question.runtime == runtime


@pytest.mark.parametrize("value", ["0", "", "nan", "-3"])
def test_a_value_that_measures_nothing_is_kept_apart(one: Callable[..., Point], value: str) -> None:
    point = one(value=value)
    assert point.question is None
    assert point.why == "its value is 0, endless or missing: nothing was measured"


@pytest.mark.parametrize("metric", ["latency_ms", "fps", "tokens_per_s"])
def test_an_endless_value_is_no_measurement(one: Callable[..., Point], metric: str) -> None:
    assert one(value="inf", metric=metric).question is None


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"device": "abacus"}, "nothing is known of the device 'abacus' (cpu)"),
        ({"device_class": "npu"}, "nothing is known of the device 'raspberry-pi-4' (npu)"),
        ({"runtime": "slide rule"}, "the runtime 'slide rule' is unknown"),
        ({"precision": "int3"}, "the precision 'int3' is unknown"),
        ({"gflops_or_gmacs": ""}, "neither the row nor data/models.csv says how much it computes"),
    ],
)
def test_what_has_no_ground_says_why(one: Callable[..., Point], changes: dict[str, str], why: str) -> None:
    point = one(**changes)
    assert point.question is None
    assert point.why == why


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"value": "fast"}, "line 3: 'fast' in the column 'value' is not a number"),
        ({"metric": "joules"}, "line 3: the metric 'joules' is unknown; allowed: latency_ms, fps, tokens_per_s"),
        ({"device_class": "tpu"}, "line 3: the device class 'tpu' is unknown; allowed: cpu, gpu, igpu, npu"),
        ({"n_layers": "many"}, "line 3: 'many' in the column"),
        ({"gflops_or_gmacs": "1,8"}, "line 3: '1,8' in the column"),
    ],
)
def test_what_is_wrong_names_its_line(told: Callable[..., str], changes: dict[str, str], says: str) -> None:
    assert says in told(**changes)


def test_empty_lines_do_not_shift_the_line_that_is_named(points_file: Path) -> None:
    head, first, *rest = points_file.read_text().splitlines()
    points_file.write_text("\n".join([head, "", first.replace("latency_ms", "joules"), *rest]))
    with pytest.raises(DataError, match="line 3: the metric"):
        read_points(points_file)


def test_a_missing_column_is_named_beside_those_that_are_there(points_file: Path) -> None:
    points_file.write_text(points_file.read_text().replace("metric", "what", 1))
    with pytest.raises(DataError, match=r"has no column 'metric'; its columns: device, .*what"):
        read_points(points_file)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "has no column 'device'; its columns: none"),
        (b"\xff\xfe\x00\x01", "cannot be read: 'utf-8' codec"),
        (b"PK\x03\x04\x00\x00", "has no column 'device'"),
        (b"device,runtime,model,precision,metric,value,device_class\n", "holds no row"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "points.csv").write_bytes(content)
    with pytest.raises(DataError, match=says):
        read_points(tmp_path / "points.csv")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read: No such file"):
        read_points(tmp_path / "points.csv")


def test_a_short_row_and_a_long_one_are_read(points_file: Path) -> None:
    head, *rest = points_file.read_text().splitlines()
    points_file.write_text("\n".join([head, f"{rest[0]},more,and more", rest[1].rsplit(",", 1)[0] + ",cpu"]))
    assert all(point.question for point in read_points(points_file))


def test_versions_of_one_runtime_become_their_mean(published: Rows, points_at: Written) -> None:
    same = [published[0] | {"value": value} for value in ("10", "40")]
    found = merge_versions(read_points(points_at([*same, published[1], published[2] | {"value": "0"}])))
    assert len(found) == 2
    assert found[0].log_ms == pytest.approx(math.log(20))


def test_fewer_threads_are_fewer_cores(one: Callable[..., Point]) -> None:
    whole, half = one().question, one(runtime="ncnn 2t").question
    assert whole is not None
    assert half is not None
    assert (whole.compute_unit.cores, half.compute_unit.cores) == (4, 2)
    assert half.compute_unit.peaks["float32"] == pytest.approx(whole.compute_unit.peaks["float32"] / 2)
    assert half.compute_unit.setting == "2t 1"


def test_int8_of_ncnns_vulkan_is_computed_by_the_processor(one: Callable[..., Point]) -> None:
    """ncnn has no int8 kernels for Vulkan; published figures of both are the same."""
    options = {"device": "jetson-agx-xavier-32gb", "device_class": "gpu", "runtime": "ncnn-vulkan 1T"}
    whole, half = one(**options, precision="int8"), one(**options, precision="fp16")
    assert whole.question is not None
    assert half.question is not None
    assert (whole.kind, whole.question.compute_unit.unit, whole.question.runtime) == ("cpu", "cpu", "ncnn-cpu")
    assert whole.question.compute_unit.cores == 1
    assert (half.kind, half.question.compute_unit.unit, half.question.runtime) == ("gpu", "gpu", "ncnn-vulkan")
    laptop = one(**(options | {"device": "rtx-a3000-laptop"}), precision="int8")
    assert laptop.why == "nothing is known of the device 'rtx-a3000-laptop' (cpu)", "its GPU is not what computed"


def test_little_and_big_cores_are_different_cores(one: Callable[..., Point]) -> None:
    found = [
        one(device="rk3588", runtime=f"ncnn-cpu 4T{more}").question for more in ("", " powersave=1", " powersave=2")
    ]
    clocks = [question.compute_unit.clock_ghz for question in found if question]
    assert clocks == [2.3, 1.8, 2.3]
    peaks = [question.compute_unit.peaks["float32"] for question in found if question]
    assert peaks[1] < peaks[0] < peaks[2], "half of all cores is a mean of both"
    assert {question.compute_unit.device for question in found if question} == {"rk3588"}


@pytest.mark.parametrize(
    ("name", "board"),
    [("jetson-agx-orin", "jetson-agx-orin-64gb"), ("jetson-orin-nano-8gb-super", "jetson-orin-nano-8gb"),
     ("raspberry-pi-5 (oc 2.9GHz)", "raspberry-pi-5"), ("raspberry-pi-4", "raspberry-pi-4")],
)  # fmt: skip
def test_a_board_is_held_out_with_its_other_names(one: Callable[..., Point], name: str, board: str) -> None:
    assert one(device=name).group == board


def test_the_parts_of_a_model_are_held_out_with_it(one: Callable[..., Point]) -> None:
    names = ("GR00T-N1.7-3B end-to-end", "GR00T-N1.7-3B backbone (ViT+LLM)", "GR00T-N1.7-3B action head (DiT, 4 steps)")
    assert {one(model=name).model for name in names} == {"gr00tn173b"}


@pytest.mark.parametrize(
    "names", [("resnet50", "ResNet-50", "resnet_50"), ("yolov11n", "yolov11n⭐", "yolo11n"), ("levit_128", "LeViT128")]
)
def test_a_model_is_held_out_with_its_other_spellings(one: Callable[..., Point], names: tuple[str, ...]) -> None:
    assert len({one(model=name).model for name in names}) == 1
    assert one(model="resnet101").model != one(model="resnet-50").model


def test_what_tensorrt_leaves_to_pytorch_is_pytorchs(one: Callable[..., Point]) -> None:
    found = [one(runtime="tensorrt dit_only", model=f"GR00T-N1.7-3B {part}", device="jetson-agx-orin-64gb",
                 device_class="gpu", precision="bf16").question
             for part in ("backbone (ViT+LLM)", "action head (DiT, 4 steps)")]  # fmt: skip
    assert [question.runtime for question in found if question] == ["torch-cuda", "tensorrt"]


def test_what_a_row_leaves_out_follows_from_the_rest(one: Callable[..., Point]) -> None:
    question = one(macts_m="", n_layers="").question
    assert question is not None
    assert 0.5e6 < question.work.activations < 20e6
    assert 5 < question.work.layers < 60


@pytest.mark.parametrize("device", known_devices().values(), ids=lambda place: f"{place.device}-{place.unit}")
def test_what_is_known_of_a_device_is_possible(device) -> None:
    assert {"float32"} <= {*device.peaks} <= {"float32", "float16", "int8"}
    assert all(peak > 0 for peak in (*device.peaks.values(), device.cores, device.clock_ghz, device.bandwidth_gb_s))
    assert device.clock_ghz < 6
    assert device.peaks.get("float16", 0) < 1000, "dense, not sparse"


@pytest.mark.parametrize(
    ("pair", "device"), published_devices().items(), ids=[f"{name}-{unit}" for name, unit in published_devices()]
)
def test_a_published_device_has_the_size_of_its_profile(pair: tuple[str, str], device: str) -> None:
    """The clock of a power mode may differ by half; units that are counted in another way may not."""
    profile = load_profile(pair[0])
    unit = profile.units["gpu" if pair[1] == "igpu" else pair[1]]
    known = known_devices()[device, pair[1]]
    assert sorted(known.isa.split()) == sorted(unit.isa), "boards with the same cores speak for each other"
    assert 0.8 < known.cores / unit.cores.value < 1.25
    for dtype, peak in known.peaks.items():
        if dtype in unit.peak_tops:
            assert 0.55 < peak / unit.peak_tops[dtype].value < 1.8
