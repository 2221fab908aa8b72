from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vlatool.errors import DataError, UsageError
from vlatool.latency_model.published_latencies import Point, read_points
from vlatool.latency_model.refit import deal_folds, one_fold, refit_points

Rows = list[dict[str, str]]
Written = Callable[[Rows], Path]


def silent(text: str, share: float | None) -> None:
    """Say nothing."""


def test_a_fold_knows_nothing_of_what_it_predicts(published: Rows, points_at: Written) -> None:
    """Other figures of what is left out change neither the predictions nor their intervals."""
    held = frozenset({"raspberry-pi-4"})
    answers = []
    for factor in (1, 7):
        rows = [row | {"value": str(factor * float(row["value"]))} if row["device"] == "raspberry-pi-4" else row
                for row in published]  # fmt: skip
        answers.append(one_fold(read_points(points_at(rows)), held, "devices", 0, 0.0))
    for first, second in zip(answers[0]["devices"], answers[1]["devices"], strict=True):
        assert first[0].group == "raspberry-pi-4"
        assert second[0].log_ms == pytest.approx(first[0].log_ms + math.log(7))
        assert repr(first[1]) == repr(second[1])
    assert answers[0]["calibrated"] != answers[1]["calibrated"], "one of its models is told there"


def test_a_calibrated_board_is_nearer(points: list[Point]) -> None:
    def off(kind: str) -> float:
        answered = [pair for name in ("raspberry-pi-4", "rk3588", "jetson-agx-orin-64gb")
                    for pair in one_fold(points, frozenset({name}), "devices", 0, 0.0)[kind]]  # fmt: skip
        errors = [abs(math.log(answer.ms) - point.log_ms) for point, answer in answered if answer.known]
        assert len(errors) > 10
        return float(np.median(errors))

    assert off("calibrated") < off("devices")


def test_every_model_and_every_board_is_left_out_once(points: list[Point]) -> None:
    asked = [point for point in points if point.question]
    for kind, names in (("models", {point.model for point in asked}), ("devices", {point.group for point in asked})):
        parts = deal_folds(asked, kind, 3)
        assert sorted(name for part in parts for name in part) == sorted(names)
    assert deal_folds(asked, "models", 1) != deal_folds(asked, "models", 2)
    assert deal_folds(asked, "devices", 1) == deal_folds(asked, "devices", 2)


def test_a_whole_file_is_scored_in_processes(published: Rows, points_at: Written) -> None:
    told: list[str] = []
    path = points_at([row for row in published if row["device"] in ("raspberry-pi-4", "rk3588")])
    before = dict(os.environ)
    found = refit_points(path, "devices", 0, 0.0, lambda text, share: told.append(text))
    assert list(found) == ["devices", "calibrated"]
    assert found["devices"]["rows"] == 12
    assert found["devices"]["predicted"] > 0
    assert found["devices"]["how"] == "each device left out whole; all fitted anew without it, 0 s each"
    assert sorted(told)[-1] == "2 of 2 parts left out"
    assert dict(os.environ) == before
    assert list(refit_points(path, "models", 0, 0.0, silent)) == ["models"]


@pytest.mark.parametrize("held_out", [None, "rows", "calibrated"])
def test_an_unknown_split_is_refused(points_file: Path, held_out: str | None) -> None:
    with pytest.raises(UsageError, match=r"with --refit, allowed: models, devices \(which tells calibrated, too\)"):
        refit_points(points_file, held_out, 0, 0.0, silent)


def test_one_board_alone_cannot_be_left_out(published: Rows, points_at: Written) -> None:
    path = points_at([row for row in published if row["device"] == "rk3588"])
    with pytest.raises(DataError, match="has fewer than two devices: nothing is left to fit on"):
        refit_points(path, "devices", 0, 0.0, silent)
