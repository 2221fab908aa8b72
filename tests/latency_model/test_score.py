from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from vlatool.errors import DataError, UsageError
from vlatool.latency_model import score
from vlatool.latency_model.model import LatencyModel
from vlatool.latency_model.score import score_points, summary_lines

Written = Callable[[list[dict[str, str]]], Path]


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch, model: LatencyModel) -> None:
    """The shipped model is the small one, which takes no seconds to read."""
    monkeypatch.setattr(score, "load_model", lambda: model)


def finite(value: object) -> bool:
    if isinstance(value, dict):
        return all(finite(each) for each in value.values())
    return not isinstance(value, float) or math.isfinite(value)


def test_every_row_of_a_known_file_is_near(points_file: Path) -> None:
    found = score_points(points_file)
    assert (found["rows"], found["predicted"]) == (60, 58)
    assert list(found["groups"]) == ["all but npu", "cpu", "gpu", "npu"]
    assert found["groups"]["all but npu"]["rows"] == 42
    for group in found["groups"].values():
        assert 0 <= group["median"] < 0.1
        assert group["median"] <= group["p90"]
        assert group["coverage"] > 0.9
        assert group["factor"] > 1
    assert sum(found["unknown"].values()) == 2


def test_the_numbers_by_hand(published: list[dict[str, str]], points_at: Written, model: LatencyModel) -> None:
    path = points_at([published[0], published[1] | {"value": "1e6"}])
    found = score_points(path)["groups"]["cpu"]
    assert found["rows"] == 2
    assert found["coverage"] == 0.5
    assert found["median"] == pytest.approx(0.5, abs=0.1), "one is right, one is off by all"


@pytest.mark.parametrize("held_out", ["models", "devices", "calibrated"])
@pytest.mark.parametrize("seed", range(4))
def test_held_out_groups_are_predicted_from_the_rest(points_file: Path, held_out: str, seed: int) -> None:
    found = score_points(points_file, held_out, seed)
    assert found["predicted"] > 0
    assert "left out" in found["how"] or "folds" in found["how"]
    assert finite(found), found
    assert found == score_points(points_file, held_out, seed)


def test_what_is_left_out_is_predicted_without_it(
    published: list[dict[str, str]], points_at: Written, points_file: Path
) -> None:
    """A model that everywhere takes ten times as long as its size says is not known beforehand."""
    honest = score_points(points_file, "models")["groups"]["all but npu"]
    slow = [row | {"value": str(10 * float(row["value"]))} if row["model"] == "resnet50" else row for row in published]
    assert score_points(points_at(slow), "models")["groups"]["all but npu"]["p90"] > 2 * honest["p90"]


def test_the_model_that_is_told_is_not_counted(points_file: Path) -> None:
    assert score_points(points_file, "devices")["rows"] == 60
    told = score_points(points_file, "calibrated")["rows"]
    assert told % 50 == 0, "each draw tells one of six models on each of ten devices"
    assert told > 0


@pytest.mark.parametrize("held_out", ["models", "devices", "calibrated"])
def test_the_last_device_of_a_kind_is_unknown_once_it_is_held_out(
    published: list[dict[str, str]], points_at: Written, held_out: str
) -> None:
    """Without a figure of an NPU left, there is no ground for one; no row counts as predicted without a number."""
    path = points_at([row for row in published if row["device"] in ("hailo-8", "raspberry-pi-4", "rk3588")])
    found = score_points(path, held_out)
    assert finite(found), found
    if held_out == "devices":
        assert "npu" not in found["groups"]
        assert found["predicted"] == 12


def test_calibrating_helps(points_file: Path) -> None:
    def off(held_out: str) -> float:
        groups = [score_points(points_file, held_out, seed)["groups"] for seed in range(4)]
        return sum(each["all but npu"]["median"] for each in groups if "all but npu" in each)

    assert off("calibrated") < off("devices")


def test_a_seed_deals_the_models(points_file: Path) -> None:
    found = [score_points(points_file, "models", seed)["groups"] for seed in range(4)]
    assert found[0] == score_points(points_file, "models", 0)["groups"]
    devices = [score_points(points_file, "devices", seed) for seed in range(2)]
    assert devices[0] == devices[1], "each device is left out, whatever the seed"


def test_an_unknown_split_is_refused(points_file: Path) -> None:
    with pytest.raises(UsageError, match="allowed: models, devices, calibrated"):
        score_points(points_file, "rows")


def test_what_cannot_be_asked_is_counted_with_its_reason(published: list[dict[str, str]], points_at: Written) -> None:
    path = points_at([published[0], *({**published[0], "device": "abacus"} for _ in range(3))])
    found = score_points(path)
    assert (found["rows"], found["predicted"]) == (4, 1)
    assert found["unknown"] == {"nothing is known of the device 'abacus' (cpu)": 3}
    text = list(summary_lines(found))
    assert "1 of 4 rows predicted" in text[1]
    assert text[-1] == "  unknown, 3: nothing is known of the device 'abacus' (cpu)"


def test_a_file_of_which_nothing_can_be_asked_has_no_numbers(
    published: list[dict[str, str]], points_at: Written
) -> None:
    for held_out in (None, "models", "devices", "calibrated"):
        found = score_points(points_at([published[0] | {"device": "abacus"}]), held_out)
        assert (found["predicted"], found["groups"]) == (0, {})
        assert list(summary_lines(found))


def test_a_person_reads_a_line_for_each_group(points_file: Path) -> None:
    found = score_points(points_file)
    text = list(summary_lines(found))
    assert text[1].startswith("58 of 60 rows predicted")
    assert [line.split()[0] for line in text[3:7]] == ["all", "cpu", "gpu", "npu"]
    assert "The interval is meant to hold 80%." in text
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_a_model_without_a_kind_of_unit_says_so(
    points_file: Path, model: LatencyModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = {"processors": model.parts["processors"]}
    monkeypatch.setattr(score, "load_model", lambda: replace(model, parts=parts))
    with pytest.raises(DataError, match="The latency model has no figures of npu"):
        score_points(points_file, "models")
