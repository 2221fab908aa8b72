from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from vlatool.graph.workload import PRECISIONS, TRAITS
from vlatool.latency_model.features import (
    LAYER_MS,
    ComputeUnit,
    Question,
    Shares,
    Work,
    roofline_ms,
    roofline_parts,
    rows_of,
)
from vlatool.latency_model.gaussian_process import KEYS

WORK = Work(1e9, 4e6, 2e6, 30, frozenset({"attention"}), "net 224")
PLACE = ComputeUnit("board", "cpu", 4, 2.0, {"float32": 0.1, "float16": 0.2, "int8": 0.4}, 10.0, "15W", "asimd asimddp")
WHOLE = Shares(**dict.fromkeys(vars(Shares()), 1.0))


def ask(
    precision: str = "float32", work: Work = WORK, place: ComputeUnit = PLACE, runtime: str = "ncnn-cpu"
) -> Question:
    return Question(work, place, runtime, precision)


def test_the_roofline_by_hand() -> None:
    found = roofline_parts(ask("float32"), WHOLE)
    assert found["compute"] == pytest.approx(2 * 1e9 / 0.1e12 * 1e3)
    assert found["memory"] == pytest.approx((4e6 + 2e6) * 4 / 10e9 * 1e3)
    assert found["overhead"] == pytest.approx(30 / 2.0 * LAYER_MS)
    assert roofline_ms(ask("float32"), WHOLE) == pytest.approx(20 + 2.4 + 15 * LAYER_MS)
    assert roofline_ms(ask("float32"), Shares()) > roofline_ms(ask("float32"), WHOLE)


@pytest.mark.parametrize(
    ("precision", "peak"),
    [("float32", 0.1), ("float16", 0.2), ("bfloat16", 0.2), ("int8", 0.4), ("float8", 0.4), ("w4", 0.2), ("w8", 0.2)],
)
def test_a_precision_computes_at_the_peak_of_what_it_becomes(precision: str, peak: float) -> None:
    assert PLACE.peak(precision) == peak
    bare = replace(PLACE, peaks={"float32": 0.1})
    assert bare.peak(precision) == 0.1, "without the units for it, as float32"


def test_float8_has_its_own_peak_where_there_is_one() -> None:
    assert replace(PLACE, peaks=PLACE.peaks | {"float8": 0.9}).peak("float8") == 0.9  # type: ignore[operator]


@pytest.mark.parametrize("precision", PRECISIONS)
def test_narrower_weights_move_fewer_bytes(precision: str) -> None:
    weight, activation = PRECISIONS[precision]
    assert roofline_parts(ask(precision), WHOLE)["memory"] == pytest.approx(
        (4e6 * weight + 2e6 * activation) / 10e9 * 1e3
    )


def test_rows_have_the_prior_the_traits_and_finite_features() -> None:
    empty = Work(0, 0, 0, 1)
    found = rows_of([ask(), ask(work=empty)], Shares())
    assert len(found) == 2
    assert found.prior[0] == pytest.approx(math.log(roofline_ms(ask(), Shares())))
    assert found.traits[0].tolist() == [float(trait == "attention") for trait in TRAITS]
    assert np.isfinite(found.model).all()
    assert np.isfinite(found.device).all()


def same(first: Question, second: Question) -> set[str]:
    """Categories that two questions share."""
    rows = rows_of([first, second], Shares())
    return {name for name in KEYS if rows.keys[name][0] == rows.keys[name][1]}


@pytest.mark.parametrize(
    ("other", "differ"),
    [
        (ask(), set()),
        (ask("int8"), {"kind", "made", "pair", "setting", "known"}),
        (ask(runtime="mnn-cpu"), {"runtime", "kind", "made", "line", "pair", "setting", "known"}),
        (ask(place=replace(PLACE, setting="7W")), {"setting"}),
        (ask(place=replace(PLACE, device="other")), {"device", "line", "pair", "setting"}),
        (ask(place=replace(PLACE, isa="avx2")), {"core", "made"}),
        (ask(place=replace(PLACE, isa="asimddp asimd")), set()),
        (ask(place=replace(PLACE, unit="gpu")), {"unit", "core", "made", "device", "line", "pair", "setting"}),
        (ask(work=replace(WORK, name="other 224")), {"model", "known"}),
        (ask(work=replace(WORK, macs=4e9)), {"model", "known"}),
    ],
    ids=["same", "precision", "runtime", "mode", "device", "cores", "order", "unit", "model", "size"],
)
def test_categories_say_what_two_questions_share(other: Question, differ: set[str]) -> None:
    assert same(ask(), other) == {*KEYS} - differ


def test_a_device_of_unknown_cores_shares_them_with_none() -> None:
    bare = replace(PLACE, isa="")
    assert same(ask(place=bare), ask(place=replace(bare, device="other"))) == {*KEYS} - {
        "core",
        "made",
        "device",
        "line",
        "pair",
        "setting",
    }


def test_float8_is_spoken_for_by_int8_and_bfloat16_by_float16() -> None:
    assert same(ask("int8"), ask("float8")) == {*KEYS}
    assert same(ask("float16"), ask("bfloat16")) == {*KEYS}


def test_works_of_ones_own_are_told_apart_by_what_they_are() -> None:
    own = Work(1e9, 1e7, 5e6, 50)
    assert "model" in same(ask(work=own), ask(work=replace(own)))
    assert "model" not in same(ask(work=own), ask(work=replace(own, layers=51)))
