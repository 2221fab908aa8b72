"""Which candidate is chosen and what is said about it; every row is built by hand."""

import math
from dataclasses import replace
from typing import Any

import pytest

from vlatool.hardware.profile import load_profile
from vlatool.optimize.choice import choose, speed_words
from vlatool.optimize.judge import Judged, judge
from vlatool.optimize.recipe import Limits
from vlatool.report import Measurement, Row

BOARD = load_profile("raspberry-pi-5")
FLOAT = Row("float32", "baseline", measurements=(Measurement("latency_p50", 10.0, "ms", samples=20),))


def row(name: str, p50: float = 5.0, *found: Measurement) -> Row:
    own = (
        Measurement("latency_p50", p50, "ms", samples=20),
        Measurement("speedup", 10 / p50, "x", samples=20, low=9.9 / p50, high=10.1 / p50),
        Measurement("size", 1.0, "MB"),
    )
    return Row(name, measurements=(*own, *found))


def drop(value: float, high: float | None = None) -> Measurement:
    return Measurement("success_drop", value, "1", samples=200, high=high, note="paired: 3 lost, 1 won of 200 episodes")


def predicted(value: float, low: float | None = None, high: float | None = None) -> Measurement:
    return Measurement("latency_p50", value, "ms", "predicted", BOARD.name, low=low, high=high)


def recorded(name: str, value: float) -> Measurement:
    return Measurement(name, value, "1", samples=64)


def held(candidate: Row, baseline: Row = FLOAT, **limits: Any) -> Judged:
    return judge(candidate, baseline, Limits(**limits), BOARD)


def chosen(*candidates: Row, baseline: Row = FLOAT, **limits: float) -> Judged:
    judged = [held(each, baseline, **limits) for each in (baseline, *candidates)]
    found = [item for item in choose(judged) if item.row.role == "chosen"]
    assert len(found) == 1
    return found[0]


# ---- accuracy


@pytest.mark.parametrize(
    ("value", "within", "says"),
    [
        (0.0, True, "success is unchanged (paired: 3 lost, 1 won of 200 episodes), within 1 point"),
        (0.01, True, "success drops by 1 point"),
        (-0.02, True, "success rises by 2 points"),
        (
            0.025,
            False,
            "success drops by 2.5 points (paired: 3 lost, 1 won of 200 episodes), 1.5 points over the budget",
        ),
    ],
)
def test_a_drop_is_held_against_the_budget(value, within, says):
    found = held(row("int8", 5.0, drop(value)))
    assert (found.within, found.row.role) == (within, "within" if within else "outside")
    assert says in found.row.reason
    assert found.drop == value


def test_a_drop_that_the_samples_cannot_exclude_is_a_warning_with_its_remedy():
    found = held(row("int8", 5.0, drop(0.0, high=0.03)))
    assert found.within
    assert "could be as large as 3 points (200 paired samples cannot exclude it)" in found.warnings[0]
    assert "--episodes" in found.warnings[0]


def test_without_accuracy_nothing_is_inside():
    found = held(row("int8"))
    assert not found.within
    assert math.isnan(found.drop)
    assert "its accuracy is unmeasured" in found.row.reason


@pytest.mark.parametrize(
    ("name", "own", "base", "wanted", "measured"),
    [
        ("agreement_expert", 0.90, 0.95, "agreement_drop", 0.05),
        ("agreement_expert", 0.97, 0.95, "agreement_drop", -0.02),
        ("error_expert", 0.30, 0.25, "error_increase", 0.05),
        ("error_expert", 0.20, 0.25, "error_increase", -0.05),
    ],
)
def test_on_recordings_the_drop_is_the_difference_in_which_more_is_worse(name, own, base, wanted, measured):
    baseline = Row("float32", "baseline", measurements=(*FLOAT.measurements, recorded(name, base)))
    found = held(row("int8", 5.0, recorded(name, own)), baseline)
    added = found.row.get(wanted)
    assert added is not None
    assert added.value == pytest.approx(measured)
    assert added.samples == 64
    assert found.within == (measured <= 0.01)


@pytest.mark.parametrize(
    ("name", "value", "wanted", "measured"),
    [("agreement_baseline", 0.98, "agreement_drop", 0.02), ("error_baseline", 0.02, "error_increase", 0.02)],
)
def test_without_expert_actions_float32_is_what_is_held_to(name, value, wanted, measured):
    found = held(row("int8", 5.0, recorded(name, value)))
    added = found.row.get(wanted)
    assert added is not None
    assert added.value == pytest.approx(measured)
    assert "float32" in added.note
    assert not found.within


def test_the_closed_loop_decides_where_there_is_one():
    baseline = Row("float32", "baseline", measurements=(*FLOAT.measurements, recorded("error_expert", 0.1)))
    found = held(row("int8", 5.0, drop(0.0), recorded("error_expert", 9.0)), baseline)
    assert found.within
    assert "success" in found.row.reason


def test_an_unknown_error_is_no_accuracy():
    assert "unmeasured" in held(row("int8", 5.0, recorded("error_baseline", math.nan))).row.reason


# ---- rate


def test_a_rate_that_the_board_is_predicted_to_miss_is_outside():
    found = held(row("int8", 5.0, drop(0.0), predicted(80.0, 60.0, 120.0)), hz=20)
    assert not found.within
    assert "predicted 80 ms (60-120) on raspberry-pi-5, 20 Hz needs 50 ms" in found.row.reason


def test_a_prediction_that_straddles_the_budget_is_a_warning():
    found = held(row("int8", 5.0, drop(0.0), predicted(45.0, 40.0, 70.0)), hz=20)
    assert found.within
    assert "too close to call, measure on the board" in found.warnings[0]


def test_a_prediction_well_inside_says_nothing():
    found = held(row("int8", 5.0, drop(0.0), predicted(10.0, 8.0, 20.0)), hz=20)
    assert found.within
    assert found.warnings == ()


@pytest.mark.parametrize("found", [(), (predicted(math.nan),)])
def test_without_a_prediction_the_rate_is_unjudged_and_that_is_said(found):
    judged = held(row("int8", 5.0, drop(0.0), *found), hz=20)
    assert judged.within
    assert "no latency can be predicted for raspberry-pi-5, so 20 Hz is unjudged" in judged.warnings[0]


def test_this_hosts_latency_says_nothing_about_another_board():
    assert held(row("int8", 5000.0, drop(0.0), predicted(10.0, 8.0, 20.0)), hz=20).within


@pytest.mark.parametrize(("p50", "within"), [(5.0, True), (80.0, False)])
def test_on_the_board_itself_the_measurement_decides(p50, within):
    candidate = row("int8", p50, drop(0.0), predicted(10.0, 8.0, 20.0))
    assert judge(candidate, FLOAT, Limits(hz=20), BOARD, on_board=True).within == within


# ---- choice


def test_the_fastest_inside_is_chosen_and_praised_with_its_numbers():
    found = chosen(row("slow", 8.0, drop(0.0)), row("fast", 4.0, drop(0.005)), row("bad", 1.0, drop(0.5)))
    assert found.row.name == "fast"
    assert found.within
    assert "2.50x as fast as float32 (4 ms instead of 10 ms, measured on this host)" in found.sentences[0]
    assert "Success drops by 0.5 points" in " ".join(found.sentences) or "the fastest inside" in found.row.reason


def test_two_per_cent_of_speed_are_not_given_away_for_accuracy():
    assert chosen(row("fast", 4.0, drop(0.005)), row("accurate", 4.08, drop(0.0))).row.name == "fast"
    assert chosen(row("fast", 4.0, drop(0.005)), row("level", 4.03, drop(0.0))).row.name == "level"


def test_the_success_rate_is_told_with_its_episodes():
    rate = Measurement("success", 0.96, "1", samples=200)
    assert "96.0% of 200 closed-loop episodes succeed" in chosen(row("fast", 4.0, drop(0.0), rate)).sentences[0]


def test_float32_is_kept_when_nothing_is_faster():
    found = chosen(row("int8", 12.0, drop(0.0)))
    assert found.row.name == "float32"
    assert "no quantized candidate is faster" in found.sentences[0]


def test_it_is_not_said_that_nothing_is_faster_when_a_candidate_outside_is():
    found = chosen(row("slow", 12.0, drop(0.0)), row("bad", 1.0, drop(0.5)))
    assert found.row.name == "float32"
    assert "no quantized candidate is faster on this host" not in found.sentences[0]


def test_float32_that_is_too_slow_for_the_board_is_not_kept():
    slow = Row("float32", "baseline", measurements=(*FLOAT.measurements, predicted(90.0, 70.0, 99.0)))
    found = chosen(row("int8", 12.0, drop(0.0), predicted(20.0, 15.0, 30.0)), baseline=slow, hz=20)
    assert found.row.name == "int8"


def test_without_any_inside_the_nearest_is_kept_and_each_says_by_how_much_it_missed():
    found = chosen(row("far", 1.0, drop(0.5)), row("near", 9.0, drop(0.03)), row("blind", 1.0))
    assert found.row.name == "near"
    assert not found.within
    assert "outside the limits" in found.row.reason
    assert found.sentences[0] == "No candidate keeps to the limits; the nearest, near, was kept."
    told = " ".join(found.sentences[1:])
    assert "far: success drops by 50 points" in told
    assert "49 points over the budget" in told
    assert "near: success drops by 3 points" in told
    assert "2 points over the budget" in told
    assert "blind: its accuracy is unmeasured" in told


def test_of_two_that_only_miss_the_rate_the_faster_on_the_board_is_the_nearest():
    far = row("far", 5.0, drop(0.0), predicted(900.0, 800.0, 999.0))
    near = row("near", 6.0, drop(0.005), predicted(60.0, 55.0, 70.0))
    assert chosen(far, near, hz=20).row.name == "near"


def test_the_order_of_the_rows_is_kept():
    judged = [held(FLOAT), held(row("a", 4.0, drop(0.0))), held(row("b", 3.0, drop(0.0)))]
    assert [(item.row.name, item.row.role) for item in choose(judged)] == [
        ("float32", "baseline"),
        ("a", "within"),
        ("b", "chosen"),
    ]


def test_for_another_engine_predictions_rank_where_every_row_has_one():
    base = Row("float32", "baseline", measurements=(*FLOAT.measurements, predicted(30.0)))
    slow_here, slow_there = row("here", 9.0, drop(0.0), predicted(5.0)), row("there", 2.0, drop(0.0), predicted(20.0))
    judged = [held(each, base) for each in (base, slow_here, slow_there)]
    found = next(item for item in choose(judged, "tensorrt") if item.row.role == "chosen")
    assert found.row.name == "here"
    assert "predicted to need 5 ms" in found.sentences[0]
    assert "not measured there" in found.sentences[0]
    assert next(item for item in choose(judged, "ort_cpu") if item.row.role == "chosen").row.name == "there"


def test_for_another_engine_one_missing_prediction_leaves_the_choice_to_the_measurements():
    judged = [held(each) for each in (FLOAT, row("a", 4.0, drop(0.0), predicted(1.0)), row("b", 3.0, drop(0.0)))]
    assert next(item for item in choose(judged, "tensorrt") if item.row.role == "chosen").row.name == "b"


def unproven(name: str, p50: float, low: float | None, high: float | None) -> Row:
    speedup = Measurement("speedup", 10 / p50, "x", samples=20, low=low, high=high)
    found = Measurement("latency_p50", p50, "ms", samples=20), speedup, Measurement("size", 1.0, "MB")
    return Row(name, measurements=(*found, drop(0.0)))


@pytest.mark.parametrize(
    ("p50", "low", "high"),
    [(10.1, 0.95, 1.02), (9.93, 0.98, 1.06), (9.1, 0.64, 1.88), (9.96, 1.001, 1.01), (5.0, None, None)],
)
def test_a_speed_up_that_the_interval_does_not_show_is_none(p50, low, high):
    found = chosen(unproven("int8", p50, low, high))
    told = " ".join(found.sentences)
    assert found.row.name == "float32"
    assert "as fast as float32 (" not in told
    assert "int8 is not shown to be faster than float32" in told
    assert f"{p50:.4g} ms instead of 10 ms" in told


@pytest.mark.parametrize("board", ["", "a board"])
@pytest.mark.parametrize(("value", "low", "high"), [(2.52, 2.4, 2.6), (2.52, None, None), (0.959, 0.9, 1.1)])
def test_the_ratio_that_is_told_is_that_of_the_table(board: str, value: float, low: float | None, high: float | None):
    speedup = Measurement("speedup", value, "x", samples=20, low=low, high=high)
    latency, size = Measurement("latency_p50", 4.0, "ms", samples=20), Measurement("size", 1.0, "MB")
    told = speed_words(Row("int8", measurements=(latency, speedup, size, drop(0.0))), FLOAT, board)
    assert f"{value:.3g}x" in told
    assert "2.5x" not in told, "the quotient of rounded medians"
    assert low is None or not (board or low < 1) or f"{low:.2f} to {high:.2f}" in told


def test_a_candidate_that_is_not_faster_is_no_rival_of_one_that_is():
    found = chosen(unproven("maybe", 3.9, 0.6, 5.0), row("sure", 4.0, drop(0.005)))
    assert found.row.name == "sure"


def test_what_is_chosen_for_its_memory_alone_is_said_to_be():
    judged = [held(each) for each in (FLOAT, row("small", 20, drop(0.0)))]
    found = next(item for item in choose(judged, small=True) if item.row.role == "chosen")
    assert "though not faster than float32: memory was asked for" in found.row.reason
    assert "small is not shown to be faster than float32 (0.5x; 0.49 to 0.51; 20 ms instead of" in found.sentences[0]
    assert "It was chosen because memory was asked for." in found.sentences[0]


def test_what_is_chosen_since_float32_is_outside_is_said_to_be():
    late = Row("float32", "baseline", measurements=(*FLOAT.measurements, predicted(90.0, 70.0, 99.0)))
    found = chosen(row("int8", 12.0, drop(0.0), predicted(20.0, 15.0, 30.0)), baseline=late, hz=20)
    assert "not shown to be faster than float32" in found.sentences[0]
    assert "It was chosen because float32 is outside: predicted 90 ms" in found.sentences[0]


def test_predictions_that_overlap_are_said_to():
    base = Row("float32", "baseline", measurements=(*FLOAT.measurements, predicted(30.0, 15.0, 60.0)))
    judged = [held(each, base) for each in (base, row("int8", 9.0, drop(0.0), predicted(20.0, 10.0, 40.0)))]
    found = next(item for item in choose(judged, "tensorrt") if item.row.role == "chosen")
    assert "1.50x as fast as float32 (whose range, 15 to 60 ms, overlaps); not measured there" in found.sentences[0]
    same = [held(each, base) for each in (base, row("int8", 9.0, drop(0.0), predicted(30.0, 10.0, 40.0)))]
    kept = next(item for item in choose(same, "tensorrt") if item.row.role == "chosen")
    assert kept.row.name == "float32"
    assert "no candidate inside the limits is predicted to be faster" in kept.sentences[0]


# ---- distance from float32


@pytest.mark.parametrize("decisive", [drop(0.0), recorded("error_expert", 0.3)])
@pytest.mark.parametrize(
    ("value", "within"), [(0.04, True), (0.25, True), (0.26, False), (11.0, False), (math.nan, False)]
)
def test_what_is_far_from_float32_is_outside_whatever_the_drop_says(decisive, value, within):
    base = Row("float32", "baseline", measurements=(*FLOAT.measurements, recorded("error_expert", 0.3)))
    found = held(row("int8", 5.0, decisive, recorded("error_baseline", value)), base)
    assert found.within is within
    if value == 11.0:
        assert "differs from float32's by 1,100 % of its standard deviation, allowed 25 %" in found.row.reason


def test_the_distance_may_be_set():
    assert held(row("int8", 5.0, drop(0.0), recorded("error_baseline", 0.5)), max_distance=0.5).within
    assert not held(row("int8", 5.0, drop(0.0), recorded("error_baseline", 0.02)), max_distance=0.01).within


def test_of_discrete_actions_the_share_of_other_answers_counts():
    assert held(row("int8", 5.0, drop(0.0), recorded("agreement_baseline", 0.8))).within
    found = held(row("int8", 5.0, drop(0.0), recorded("agreement_baseline", 0.7)))
    assert "30 % of the answers are not those of float32, allowed 25 %" in found.row.reason


def test_a_limit_on_a_distance_of_the_users_own_stands_in_its_place():
    far = recorded("error_baseline", 0.5)
    limits = {"metric": "relative_error", "max_metric": 0.4}
    assert held(row("int8", 5.0, far, recorded("relative_error", 0.3)), **limits).within
    assert held(row("int8", 5.0, far), max_drop=0.6).within, "no expert: the drop is the distance"


# ---- budgets in other measures, latency, memory


def metric(name: str, value: float, unit: str = "1") -> Measurement:
    return Measurement(name, value, unit, samples=12)


@pytest.mark.parametrize(("value", "within"), [(0.04, True), (0.0401, False)])
def test_a_named_measurement_decides_in_the_place_of_success(value: float, within: bool) -> None:
    found = held(row("a", 5, metric("relative_error", value), drop(0.5)), metric="relative_error", max_metric=0.04)
    assert found.within is within
    assert f"relative_error is {value:g}" in found.row.reason


def test_an_action_element_is_named_by_its_label() -> None:
    found = held(row("a", 5, metric("error_baseline.dx", 0.003, "m")), metric="dx", max_metric=0.002)
    assert not found.within
    assert found.row.reason == "error_baseline.dx is 0.003 m, allowed 0.002 m"
    assert found.miss == pytest.approx(0.5)


def test_a_unit_means_its_worst_element() -> None:
    errors = (
        metric("error_baseline.dx", 0.001, "m"),
        metric("error_baseline.dy", 0.004, "m"),
        metric("error_baseline.yaw", 9.0, "rad"),
    )
    assert held(row("a", 5, *errors), metric="unit:m", max_metric=0.004).within
    assert not held(row("a", 5, *errors), metric="unit:m", max_metric=0.003).within


def test_a_measurement_that_is_not_there_is_unmeasured() -> None:
    found = held(row("a", 5, drop(0.0)), metric="unit:furlong", max_metric=1.0)
    assert not found.within
    assert math.isinf(found.miss)


def test_the_shorter_of_rate_and_latency_counts() -> None:
    assert Limits(hz=20, max_latency_ms=10).latency_ms == 10
    assert Limits(hz=200, max_latency_ms=10).latency_ms == 5
    assert Limits().latency_ms is None


def test_without_a_profile_the_latency_of_this_host_decides() -> None:
    slow = judge(row("a", 5, drop(0.0)), FLOAT, Limits(max_latency_ms=4), None)
    assert not slow.within
    assert "p90 latency 5 ms > 4 ms" in slow.row.reason


@pytest.mark.parametrize(("limit", "within"), [(100, True), (99, False)])
def test_memory_is_what_a_fresh_process_took_here(limit: float, within: bool) -> None:
    found = judge(row("a", 5, drop(0.0), metric("peak_rss", 100, "MB")), FLOAT, Limits(max_memory_mb=limit), None)
    assert found.within is within


def test_memory_of_another_board_is_predicted_or_unjudged() -> None:
    memory = Measurement("memory", 700, "MB", "predicted", BOARD.name)
    assert not held(row("a", 5, drop(0.0), memory), max_memory_mb=600).within
    unknown = held(row("a", 5, drop(0.0)), max_memory_mb=600)
    assert unknown.within
    assert any("unjudged" in warning for warning in unknown.warnings)


def test_float32_is_no_answer_when_memory_was_asked_for() -> None:
    slower = row("small", 20, drop(0.0))
    judged = [held(each, FLOAT) for each in (FLOAT, slower)]
    assert next(item.row.name for item in choose(judged) if item.row.role == "chosen") == "float32"
    assert next(item.row.name for item in choose(judged, small=True) if item.row.role == "chosen") == "small"


# ---- for a board that is not this host


def elsewhere(*candidates: Row, baseline: Row = FLOAT) -> str:
    judged = [held(each, baseline) for each in (baseline, *candidates)]
    return next(item for item in choose(judged, elsewhere=BOARD.name) if item.row.role == "chosen").sentences[0]


@pytest.mark.parametrize("ms", [2.0, 12.0])
def test_float32_is_kept_where_no_candidate_could_be_judged(ms: float):
    found = chosen(row("blind", ms))
    assert (found.row.name, found.within) == ("float32", True)
    assert found.sentences[0].startswith("float32 was kept: no candidate could be judged.")
    assert "blind: its accuracy is unmeasured" in " ".join(found.sentences[1:])


def test_a_ratio_for_a_board_is_the_one_of_the_table():
    paired = Measurement("speedup", 3.02, "x", samples=20, low=1.58, high=4.74)
    fast = row("fast", 4.0, drop(0.0))
    others = tuple(each for each in fast.measurements if each.name != "speedup")
    found = elsewhere(replace(fast, measurements=(*others, paired)))
    assert found.startswith("fast is 3.02x as fast as float32 (1.58 to 4.74; measured on this host)")


def test_the_first_sentence_has_what_was_measured_here_beside_what_is_predicted_for_the_board():
    rate = Measurement("success", 0.96, "1", samples=200)
    base = Row("float32", "baseline", measurements=(*FLOAT.measurements, predicted(300.0, 200.0, 500.0)))
    found = elsewhere(row("fast", 4.0, drop(0.0), rate, predicted(120.0, 90.0, 160.0)), baseline=base)
    assert found.startswith("fast is 2.50x as fast as float32 (2.48 to 2.52; measured on this host); its graphs take")
    assert "96.0% of 200 closed-loop episodes succeed." in found
    told = "Predicted for raspberry-pi-5, not measured there: 120 ms (90 to 160, 95%), float32 300 ms."
    assert found.endswith(told)
    assert "4 ms" not in found


def test_float32_that_is_kept_for_a_board_is_told_with_its_prediction():
    base = Row("float32", "baseline", measurements=(*FLOAT.measurements, predicted(300.0, 200.0, 500.0)))
    found = elsewhere(row("int8", 12.0, drop(0.0)), baseline=base)
    assert found.endswith(" Predicted for raspberry-pi-5, not measured there: 300 ms (200 to 500, 95%).")


def test_the_nearest_is_told_with_both_sides_and_a_prediction_that_lacks_is_said_to():
    found = elsewhere(row("far", 4.0, drop(0.5)))
    assert found.startswith("No candidate keeps to the limits; the nearest, far, was kept. It is 2.50x as fast")
    assert "10 ms" not in found
    assert found.endswith("No latency can be predicted for raspberry-pi-5.")
