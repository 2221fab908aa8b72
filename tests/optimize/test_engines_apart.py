"""The choice where each engine is held against itself; every row is built by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vlatool.machine.instruction_sets import compare_sets
from vlatool.measures.latency import OPENVINO_FLOAT32_P50
from vlatool.optimize.choice_apart import choose_apart, on_board
from vlatool.optimize.judge import Judged
from vlatool.optimize.result import about_int8, in_int8
from vlatool.optimize.timings import IN_OPENVINO, join_rows, relabel_where
from vlatool.report import Measurement, Row

SET = compare_sets("old", ("avx2",), ("avx2", "avx512f", "avx512_vnni"), "AVX2")
ENGINES = {"ort": "ort_cpu", "fast": "openvino", "slow": "openvino"}
BOARD = ("ort_cpu", "openvino")


def judged(name: str, p50: float, of: float, predicted: float | None, within: bool = True) -> Judged:
    found = [
        Measurement("latency_p50", p50, "ms", samples=20), Measurement("size", 1.0, "MB"),
        Measurement("speedup", of / p50, "x", samples=20, low=0.99 * of / p50, high=1.01 * of / p50),
    ]  # fmt: skip
    found += [Measurement("latency_p50", predicted, "ms", "predicted", "old")] if predicted else []
    return Judged(
        Row(name, "within" if within else "outside", "drops", tuple(found)), within, 0.01, 0.0 if within else 1
    )


def baseline(predicted: float | None = 20.0, reference: float | None = 25.0) -> Judged:
    found = [
        Measurement("latency_p50", 10.0, "ms"),
        OPENVINO_FLOAT32_P50.measurement(40.0),
        Measurement("size", 4.0, "MB"),
    ]
    found += [Measurement("latency_p50", predicted, "ms", "predicted", "old")] if predicted else []
    found += [OPENVINO_FLOAT32_P50.prediction(reference, "old")] if reference else []
    return Judged(Row("float32", "baseline", "the reference", tuple(found)), True, 0.0)


def choose(*items: Judged, small: bool = False) -> Judged:
    found = [item for item in choose_apart(list(items), ENGINES, BOARD, SET, small) if item.row.role == "chosen"]
    assert len(found) == 1
    return found[0]


def test_what_is_slower_in_milliseconds_wins_where_the_board_says_so():
    """20 ms of OpenVINO are 2x of its own 40 ms: 12.5 ms on the board, where ONNX Runtime's plan takes 15."""
    best = choose(baseline(), judged("ort", 5.0, 10.0, 15.0), judged("fast", 20.0, 40.0, 30.0))
    assert best.row.name == "fast"
    said = " ".join(best.sentences)
    assert f"2.00x as fast as {IN_OPENVINO} (20 ms instead of 40 ms" in best.sentences[0]
    assert best.sentences[1] == "That is a ratio of the instruction set of old (AVX2), on another core."
    assert "predictions for the board decided (fast 12.5 ms, ort 15 ms, float32 20 ms" in said


def test_a_fast_host_does_not_speak_for_the_other_engine():
    best = choose(baseline(), judged("ort", 1.0, 10.0, 9.0), judged("fast", 20.0, 40.0, None))
    assert best.row.name == "ort"
    assert (
        best.sentences[1] == "That is a ratio of this host's own instruction set (AVX512_CORE_VNNI), not of old (AVX2)."
    )
    assert not any("OpenVINO" in each and "1.00x" in each for each in best.sentences)


def test_what_loses_in_its_own_engine_is_not_chosen():
    best = choose(baseline(), judged("fast", 60.0, 40.0, 1.0), judged("slow", 70.0, 40.0, 1.0))
    assert best.row.name == "float32"
    assert best.sentences[0].startswith("float32 was kept: no candidate inside the limits is faster")
    assert any(f"fast is not shown to be faster than {IN_OPENVINO} (0.667x" in each for each in best.sentences)


def test_float32_stays_where_the_board_is_expected_to_run_nothing_faster():
    best = choose(baseline(predicted=5.0), judged("ort", 5.0, 10.0, 15.0), judged("fast", 20.0, 40.0, 30.0))
    assert best.row.name == "float32"
    assert "no candidate is predicted to be faster" in best.row.reason


def test_without_predictions_the_preferred_engine_decides():
    best = choose(baseline(None, None), judged("fast", 20.0, 40.0, None), judged("ort", 8.0, 10.0, None))
    assert best.row.name == "ort"
    assert "the profile names first" in best.sentences[-1].replace("board's ", "")


def test_only_what_keeps_to_the_limits_is_chosen_and_the_nearest_where_nothing_does():
    within, outside = judged("ort", 5.0, 10.0, 15.0), judged("fast", 4.0, 40.0, 1.0, within=False)
    assert choose(baseline(), outside, within).row.name == "ort"
    assert choose(baseline(), outside, replace(within, within=False, miss=9.0)).row.name == "fast"


def test_memory_that_was_asked_for_leaves_float32_out():
    assert choose(baseline(predicted=1.0), judged("ort", 5.0, 10.0, 15.0), small=True).row.name == "ort"


def test_a_plan_on_the_board_takes_its_float32_by_its_own_speedup():
    base = baseline().row
    assert on_board(judged("fast", 20.0, 40.0, 30.0).row, base, ENGINES) == 12.5
    assert on_board(judged("ort", 5.0, 10.0, 15.0).row, base, ENGINES) == 15.0
    assert on_board(base, base, ENGINES) == 20.0


def test_rows_of_two_runs_are_joined_and_say_what_their_ratios_are():
    ours = {"float32": Row("float32"), "ort": judged("ort", 5.0, 10.0, None).row}
    theirs = {"float32": judged("float32", 40.0, 40.0, None).row, "fast": judged("fast", 20.0, 40.0, None).row}
    found = join_rows(ours, theirs, ["float32", "fast", "ort"], SET)
    assert list(found) == ["float32", "fast", "ort"]
    assert found["float32"].role == "baseline"
    reference = found["float32"].get(OPENVINO_FLOAT32_P50)
    assert (reference.value, reference.where) == (40.0, "this host, OpenVINO confined to AVX2")
    assert found["float32"].get("latency_p50") is None, "OpenVINO's own is no latency of the reference"
    assert (
        "float32 in OpenVINO, interleaved: the instruction set of old (AVX2), on another core"
        in found["fast"].get("speedup").note
    )
    assert "float32 in ONNX Runtime, interleaved: this host's own instruction set" in found["ort"].get("speedup").note


def test_what_was_measured_confined_is_placed_there_and_predictions_are_not():
    rows = {"fast": judged("fast", 20.0, 40.0, 30.0).row, "ort": judged("ort", 5.0, 10.0, 15.0).row}
    found = relabel_where(rows, ENGINES, SET)
    assert {each.where for each in found["fast"].measurements} == {"this host, OpenVINO confined to AVX2", "old"}
    assert {each.where for each in found["ort"].measurements} == {"this host", "old"}


@pytest.mark.parametrize(
    ("p50", "verdict"), [(60.0, "fast is 0.67x (0.66 to 0.67)"), (20.0, "it wins there"), (60.0, "it loses there"),
                         (40.0, "it is not shown to win there")],
)  # fmt: skip
def test_a_board_without_vnni_is_told_how_int8_does(p50: float, verdict: str):
    (said,) = about_int8({"fast": judged("fast", p50, 40.0, None).row}, ENGINES, SET)
    assert said.startswith("old has no VNNI: int8 products are added in pairs of 16 bits there")
    assert verdict in said
    assert "as fast as float32 in OpenVINO, of the instruction set of old (AVX2), on another core" in said


def test_only_what_multiplies_in_int8_tells_how_int8_does(float_bundle):
    def computing(precision):
        graph = replace(float_bundle.manifest.graphs["main"], precision=precision)
        return replace(float_bundle, manifest=replace(float_bundle.manifest, graphs={"main": graph}))

    bundles = {"weights": computing({"float32": 1.0}), "fast": computing({"int8": 0.9, "float32": 0.1})}
    assert in_int8(bundles) == {"fast": "ort_cpu"}


def test_a_board_without_vnni_and_without_a_plan_is_told_too_and_one_with_vnni_nothing():
    assert "no int8 plan of OpenVINO could be made" in about_int8({}, ENGINES, SET)[0]
    assert about_int8({}, ENGINES, compare_sets("nuc", ("avx_vnni",), ("avx_vnni", "avx512f"), "AVX2_VNNI")) == ()


@pytest.mark.parametrize(
    ("host", "told"), [(("avx2", "avx_vnni"), ""), (("avx2", "avx512f", "avx512_vnni"), "AVX512_CORE_VNNI")]
)
def test_what_was_timed_in_another_set_does_not_say_how_int8_does_on_the_board(host: tuple[str, ...], told: str):
    where = compare_sets("old", ("avx2", "avx512f"), host, told)
    (said,) = about_int8({"fast": judged("fast", 20.0, 40.0, None).row}, ENGINES, where)
    assert said.startswith("old has no VNNI")
    assert "wins" not in said
    assert "2.00x" not in said
