from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from landmarks import fitted

from vlatool.errors import DataError, OutputError
from vlatool.latency_model import fit, model
from vlatool.latency_model.features import Question, Shares, rows_of
from vlatool.latency_model.fit import (
    SHRINKAGE_COUNT,
    Scores,
    conformal,
    fit_files,
    loss,
    search_objective,
    subsample,
    tune,
)
from vlatool.latency_model.folds import Folds, Sample
from vlatool.latency_model.gaussian_process import Process, Scales
from vlatool.latency_model.model import LEVEL, LatencyModel, read_model
from vlatool.latency_model.published_latencies import Point, read_points

SCALES, SHARES = Scales(), Shares()


def told_by(*arguments: Any, **options: Any) -> list[str]:
    """What a fit says."""
    told: list[str] = []
    fit_files(*arguments, **options, tell=told.append)
    return told


def some(sample: Sample, which: np.ndarray) -> list[Question]:
    """The questions of some rows."""
    return [question for question, kept in zip(sample.questions, which, strict=True) if kept]


def refitted(sample: Sample, known: np.ndarray, asked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error and deviation of the rows that are asked, of a process that knows the others."""
    process = Process(rows_of(some(sample, known), SHARES), sample.logs[known], SCALES)
    mean, deviation = process.predict(rows_of(some(sample, asked), SHARES))
    return mean - sample.logs[asked], deviation


@pytest.fixture
def folds(sample: Sample) -> Folds:
    return Folds(rows_of(sample.questions, SHARES), sample, SCALES)


@pytest.mark.parametrize("name", ["models", "devices"])
def test_leaving_a_group_out_is_fitting_without_it(folds: Folds, sample: Sample, name: str) -> None:
    groups = getattr(sample, name)
    error, deviation = folds.leave_out(groups)
    for code in np.unique(groups):
        wanted = refitted(sample, groups != code, groups == code)
        np.testing.assert_allclose(error[groups == code], wanted[0], atol=1e-8)
        np.testing.assert_allclose(deviation[groups == code], wanted[1], atol=1e-8)


def test_telling_one_model_of_a_device_is_fitting_with_it(folds: Folds, sample: Sample) -> None:
    error, deviation, places, _ = folds.leave_out_calibrated(sample.devices)
    at = 0
    for device in np.unique(sample.devices):
        mine = sample.devices == device
        for other in np.unique(sample.models[mine]):
            asked = mine & (sample.models != other)
            part = slice(at, at := at + int(asked.sum()))
            np.testing.assert_array_equal(places[part], np.flatnonzero(asked))
            wanted = refitted(sample, ~asked, asked)
            np.testing.assert_allclose(error[part], wanted[0], atol=1e-8)
            np.testing.assert_allclose(deviation[part], wanted[1], atol=1e-8)
    assert at == len(error)


def test_once_tells_one_model_of_each_device(folds: Folds, sample: Sample) -> None:
    error, deviation, told = folds.leave_out_once(sample.devices, np.random.default_rng(0))
    for device in np.unique(sample.devices):
        mine = sample.devices == device
        (model,) = np.unique(sample.models[mine & told])
        assert (told[mine] == (sample.models[mine] == model)).all()
        asked = mine & ~told
        wanted = refitted(sample, ~asked, asked)
        np.testing.assert_allclose(error[asked], wanted[0], atol=1e-8)
        np.testing.assert_allclose(deviation[asked], wanted[1], atol=1e-8)


def test_no_more_models_are_told_than_asked_for(folds: Folds, sample: Sample) -> None:
    few, all_of_them = (len(folds.leave_out_calibrated(sample.devices, most)[0]) for most in (2, 32))
    assert few == all_of_them / 3, "two of six models each"


def test_devices_with_one_model_each_can_be_assessed(points: list[Point]) -> None:
    """Nothing is left to predict once the one model is told; that is no reason to fail."""
    single = Sample.from_points([point for point in points if point.model == "resnet50" and point.kind != "npu"])
    assert math.isfinite(search_objective(single, SCALES, SHARES))


def test_the_loss_is_relative_and_weighs_the_tail() -> None:
    assert loss(np.log([1.1, 1.1, 1.1])) == pytest.approx(0.1 + 0.3 * 0.1)
    assert loss(np.zeros(5)) == 0
    assert loss(np.log([1.0] * 8 + [2.0, 2.0])) > 0.2


def test_intervals_hold_their_share_of_what_was_left_out(sample: Sample, folds: Folds) -> None:
    found = conformal(sample, SCALES, SHARES)
    assert set(found) == {"known", "unseen", "calibrated"}
    error, deviation = folds.leave_out(sample.models)
    inside = np.abs(error) / deviation <= found["known"]["npu"] + 1e-9
    most = LEVEL * 7 / 6 + 2 / len(error)
    assert LEVEL <= inside.mean() <= most, "all of them speak for a unit that has none; six models are few"
    error, deviation, places, _ = folds.leave_out_calibrated(sample.devices)
    cpu = sample.units[places] == 0
    inside = (np.abs(error) / deviation)[cpu] <= found["calibrated"]["cpu"] + 1e-9
    assert inside.mean() >= LEVEL, "three devices, whose figures lie nearer than those of all"
    everywhere = Scores.for_calibrated(sample, folds)
    assert found["calibrated"]["cpu"] == everywhere.quantile(0)
    whole = np.abs(error) / deviation <= everywhere.quantile(3) + 1e-9
    assert whole.mean() == pytest.approx(LEVEL, abs=0.05), "all of them, by devices"


def test_the_search_lowers_what_it_assesses(sample: Sample) -> None:
    told: list[str] = []
    before = search_objective(sample, SCALES, SHARES)
    scales, shares = tune(sample, SCALES, SHARES, 3.0, tell=told.append)
    assert search_objective(sample, scales, shares) < before
    assert told
    assert all(0 < getattr(shares, name.name) <= 1 for name in dataclasses.fields(shares) if name.name != "layers")
    assert scales.constant == SCALES.constant, "the constant is not searched"


def test_without_time_nothing_is_searched(sample: Sample) -> None:
    assert tune(sample, SCALES, SHARES, 0) == (SCALES, SHARES)


def test_points_without_a_question_are_left_out(points: list[Point]) -> None:
    broken = dataclasses.replace(points[0], question=None, why="no ground")
    found = Sample.from_points([broken, *points[:6]])
    assert len(found.logs) == 6
    assert found.logs.tolist() == [point.log_ms for point in points[:6]]


def test_a_model_of_other_figures_keeps_the_scales(points: list[Point], model: LatencyModel) -> None:
    found = fitted(points[:30], model)
    assert set(found.parts) == {"processors"}
    assert found.parts["processors"].scales == model.parts["processors"].scales
    assert len(found.parts["processors"].rows) == 30
    assert found.conformal == model.conformal


@pytest.fixture
def no_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for the model's data, empty; the fit begins from the built-in scales then."""
    folder = tmp_path / "data"
    folder.mkdir()
    monkeypatch.setattr(fit, "DATA", folder)
    monkeypatch.setattr(model, "DATA", folder)
    model.read_model.cache_clear()
    yield folder
    model.read_model.cache_clear()


def test_a_fit_anew_does_not_begin_at_the_shipped_scales(points_file: Path, tmp_path: Path) -> None:
    for anew in (False, True):
        told_by(points_file, tmp_path, seconds=0, seed=0, anew=anew)
        scales = read_model(tmp_path).parts["processors"].scales
        assert (scales == Scales()) == anew
        read_model.cache_clear()


def test_a_fit_begins_at_what_was_shipped_whatever_the_user_has(
    points_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VLATOOL_LATENCY", str(tmp_path / "none yet"))
    told_by(points_file, tmp_path / "made", seconds=0, seed=0)
    assert read_model(tmp_path / "made").parts["npu"].scales == read_model(model.DATA).parts["npu"].scales


def test_a_fit_writes_what_is_then_read(points_file: Path, no_data: Path) -> None:
    told = told_by(points_file, no_data, seconds=0, seed=3)
    assert told[0] == "processors: 42 figures of 7 devices and 6 models"
    assert told[-1].startswith("written: ")
    assert json.loads((no_data / "latency.json").read_text())["about"] == {"figures": 60, "seed": 3, "level": LEVEL}
    questions = [point.question for point in read_points(points_file) if point.question]
    found = model.load_model().predict(questions)
    for answer, point in zip(found, read_points(points_file), strict=True):
        assert not answer.known or abs(answer.ms / math.exp(point.log_ms) - 1) < 0.15, "what it was fitted on, it knows"
    assert sum(answer.known for answer in found) == 58, "all but a transformer on two Hailos"
    again = told_by(points_file, no_data, seconds=0, seed=3)
    assert again == told, "from its own data, the same"


def test_a_fit_is_repeated_to_the_byte(points_file: Path, no_data: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        told_by(points_file, tmp_path / name, seconds=0, seed=0)
    assert (tmp_path / "one/latency.json").read_bytes() == (tmp_path / "two/latency.json").read_bytes()
    with np.load(tmp_path / "one/latency.npz") as first, np.load(tmp_path / "two/latency.npz") as second:
        for name in first.files:
            np.testing.assert_array_equal(first[name], second[name])


def test_a_file_without_an_npu_can_be_fitted(
    published: list[dict[str, str]], points_at: Callable[..., Path], no_data: Path
) -> None:
    path = points_at([row for row in published if row["device_class"] != "npu"])
    assert told_by(path, no_data, seconds=0, seed=0)[-1].startswith("written: ")


def test_a_fit_without_a_row_to_ask_says_why(
    published: list[dict[str, str]], points_at: Callable[..., Path], tmp_path: Path
) -> None:
    path = points_at([published[0] | {"device": "abacus"}])
    with pytest.raises(DataError, match=r"points.*csv has no row to fit on: nothing is known of the device 'abacus'"):
        told_by(path, tmp_path / "made", seconds=0, seed=0, anew=True)


def test_the_search_looks_at_some_figures_of_each_setting(points: list[Point]) -> None:
    assert len(subsample(points, limit=20)) == len({point.question for point in points if point.question})
    few = subsample(points, limit=2, seed=1)
    settings = [(point.group, point.question.runtime, point.question.precision) for point in few if point.question]
    assert max(map(settings.count, settings)) == 2
    assert set(few) < set(points)
    assert few == subsample(points, limit=2, seed=1)
    assert few != subsample(points, limit=2, seed=2)


def scored(values: np.ndarray, groups: np.ndarray, units: np.ndarray) -> Scores:
    return Scores(values, groups, units, groups)


def test_a_unit_of_few_devices_is_drawn_towards_all() -> None:
    """Fifty figures of two devices are two witnesses."""
    few, others = np.repeat([0, 1], 25), np.arange(2, 2 + 400)
    values, units = np.append(np.full(50, 0.1), np.full(400, 2.0)), np.repeat([2, 0], [50, 400])
    scores = scored(values, np.append(few, others), units)
    assert scores.quantile(2) == pytest.approx((2 * 0.1 + SHRINKAGE_COUNT * 2.0) / (2 + SHRINKAGE_COUNT))
    assert scores.quantile(1) == pytest.approx(2.0 * SHRINKAGE_COUNT / SHRINKAGE_COUNT), (
        "a unit without figures has those of all"
    )
    many = scored(values, np.append(np.arange(50), 50 + others), units)
    assert many.quantile(2) < 0.3
    assert scores.quantile(2, but=0) == pytest.approx((0.1 + SHRINKAGE_COUNT * 2.0) / (1 + SHRINKAGE_COUNT))
    lone = scored(values[:25], scores.groups[:25], units[:25])
    assert lone.quantile(2, but=0) == math.inf, "nothing is left"


def test_figures_of_one_device_are_no_independent_witnesses() -> None:
    """A device with a hundred figures counts as ten, not as a hundred, beside eighty with one."""
    values = np.append(np.full(100, 3.0), np.linspace(0.1, 2.0, 80))
    units = np.zeros(180, int)
    together = scored(values, np.append(np.zeros(100), np.arange(1, 81)), units)
    assert together.quantile(0) < 3.0
    apart = scored(values, np.arange(180), units)
    assert apart.quantile(0) == 3.0


def test_few_draws_widen_the_interval() -> None:
    """Of nine draws, each as likely to be the largest, four fifths of the next are below the eighth."""
    values, units = np.arange(1.0, 10.0), np.zeros(9, int)
    assert scored(values, np.arange(9), units).quantile(0) == 8
    assert Scores(values, np.arange(9), units, np.arange(9) + 0.0).quantile(0) == 8
    many = Scores(np.repeat(values, 50), np.repeat(np.arange(9), 50), np.zeros(450, int), np.arange(450))
    assert many.quantile(0) == 8
    plain = Scores(np.arange(1.0, 101.0), np.arange(100), np.zeros(100, int), np.arange(100))
    assert plain.quantile(0) == 81


@pytest.mark.parametrize("text", ["mine", "[]", '{"about": 1}', None])
def test_a_fit_replaces_no_file_that_is_no_model(tmp_path: Path, text: str | None) -> None:
    name = "latency.npz" if text is None else "latency.json"
    (tmp_path / name).write_text(text or "mine")
    with pytest.raises(OutputError, match=f"{name} is not a model"):
        fit_files(tmp_path / "points.csv", tmp_path, 0, 0)
    assert (tmp_path / name).read_text() == (text or "mine")
