from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vlatool.errors import DataError
from vlatool.graph.workload import Workload
from vlatool.hardware.profile import load_profile, profile_names
from vlatool.latency_model import model as module
from vlatool.latency_model.features import ComputeUnit, Question, Work
from vlatool.latency_model.model import (
    MAX_HALF_INTERVAL,
    LatencyModel,
    crowded_runtimes,
    load_model,
    part_of,
    read_model,
    unknown_reason,
    write,
)
from vlatool.latency_model.published_latencies import Point, known_devices

CONV = Work(1.8e9, 11.7e6, 2.5e6, 21)
VIT = Work(4.6e9, 22e6, 11.9e6, 74, frozenset({"attention"}))
PI = known_devices()["raspberry-pi-4", "cpu"]
HAILO = known_devices()["hailo-8", "npu"]
NEW = ComputeUnit("my-board", "cpu", 4, 2.0, {"float32": 0.12, "int8": 0.5}, 15.0)


def ask(work: Work = CONV, place: ComputeUnit = PI, runtime: str = "ncnn-cpu", precision: str = "float32") -> Question:
    return Question(work, place, runtime, precision)


@pytest.fixture
def reread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[LatencyModel], LatencyModel]]:
    """Write a model and read it as the shipped one is read."""

    def through(model: LatencyModel) -> LatencyModel:
        write(model, tmp_path)
        monkeypatch.setattr(module, "DATA", tmp_path)
        read_model.cache_clear()
        return load_model()

    yield through
    read_model.cache_clear()


def test_what_was_measured_is_answered_as_measured(model: LatencyModel, points: list[Point]) -> None:
    found = model.predict([point.question for point in points if point.question])
    assert [point.model for answer, point in zip(found, points, strict=True) if not answer.known] == ["vitsmall"] * 2
    for answer, point in zip(found, points, strict=True):
        if point.model == "vitsmall" and point.group.startswith("hailo"):
            continue
        assert answer.regime == "known"
        assert answer.ms == pytest.approx(math.exp(point.log_ms), rel=0.15)
        assert 0 < answer.low <= answer.ms <= answer.high


def test_answers_are_in_the_order_of_the_questions(model: LatencyModel) -> None:
    asked = [ask(), ask(place=HAILO, runtime="hailort", precision="int8"), ask(VIT)]
    for alone, together in zip(asked, model.predict(asked), strict=True):
        assert model.predict([alone])[0].ms == pytest.approx(together.ms)
    assert model.predict([]) == []


@pytest.mark.parametrize(
    ("question", "why"),
    [
        (ask(VIT, HAILO, "hailort", "int8"), "a transformer's latency there is unknown"),
        (ask(place=HAILO, runtime="hailort"), "the unit does not compute in float32"),
        (ask(place=HAILO, runtime="hailort", precision="w4"), "the unit does not compute in w4"),
        (ask(runtime="abacus"), "no latency was published for the runtime abacus"),
        (ask(runtime=""), "no latency was published for the runtime "),
        (ask(place=HAILO, runtime="ncnn-cpu", precision="int8"), "no latency was published for the runtime ncnn-cpu"),
    ],
    ids=["transformer-on-hailo", "float32-on-npu", "w4-on-npu", "unknown", "none", "runtime-of-the-other-part"],
)
def test_without_ground_there_is_no_number_but_a_reason(model: LatencyModel, question: Question, why: str) -> None:
    given = replace(
        question, compute_unit=replace(question.compute_unit, peaks={**question.compute_unit.peaks, "float32": 1.0})
    )
    answer = model.predict([given])[0]
    assert not answer.known
    assert math.isnan(answer.ms)
    assert why in answer.why


def test_too_wide_an_interval_is_no_answer(model: LatencyModel) -> None:
    wide = {part: {regime: dict.fromkeys(units, 99.0) for regime, units in each.items()}
            for part, each in model.conformal.items()}  # fmt: skip
    answer = replace(model, conformal=wide).predict([ask()])[0]
    assert not answer.known
    assert "measure it on the board" in answer.why
    assert "a factor of " in answer.why


def test_a_part_that_is_missing_has_no_answer(model: LatencyModel) -> None:
    """A model that was fitted without an NPU says so of a question about one, and gives no number without a reason."""
    bare = replace(model, parts={"processors": model.parts["processors"]})
    answer = bare.predict([ask(place=HAILO, runtime="hailort", precision="int8")])[0]
    assert not answer.known


def test_a_measurement_on_a_new_board_counts_there(model: LatencyModel) -> None:
    other = replace(CONV, macs=3e9, layers=30)
    before = model.predict([ask(other, NEW)])[0]
    told = model.condition([(ask(CONV, NEW), 4 * model.predict([ask(CONV, NEW)])[0].ms)])
    after = told.predict([ask(other, NEW)])[0]
    assert (before.regime, after.regime) == ("unseen", "calibrated")
    assert after.ms > 1.5 * before.ms, "the board is slower than was thought"
    assert told.predict([ask(other)])[0].regime == "known", "other boards are as they were"
    assert model.predict([ask(other, NEW)])[0].ms == pytest.approx(before.ms), "the model itself is as it was"


def test_a_measurement_is_believed(model: LatencyModel) -> None:
    told = model.condition([(ask(CONV, NEW), 123.0)])
    assert told.predict([ask(CONV, NEW)])[0].ms == pytest.approx(123.0, rel=0.1)


def test_nothing_measured_changes_nothing(model: LatencyModel) -> None:
    same = model.condition([])
    assert same.parts == model.parts
    assert same.own == frozenset()


def test_what_was_measured_is_taken_in_once(model: LatencyModel) -> None:
    told = model.condition([(ask(CONV, NEW), 123.0)])
    assert model.condition([(ask(CONV, NEW), 123.0)]) is told, "for each bundle that a command predicts"
    other = model.condition([(ask(CONV, NEW), 60.0)])
    assert other.predict([ask(CONV, NEW)])[0].ms < told.predict([ask(CONV, NEW)])[0].ms


def test_what_is_written_is_read(model: LatencyModel, points: list[Point], reread: Callable[..., LatencyModel]) -> None:
    asked = [point.question for point in points if point.question] + [ask(VIT, NEW), ask(CONV, NEW)]
    found = reread(model)
    assert found.about == model.about
    for wrote, read in zip(model.predict(asked), found.predict(asked), strict=True):
        assert (read.regime, read.why) == (wrote.regime, wrote.why)
        for name in ("ms", "low", "high"):
            np.testing.assert_allclose(getattr(read, name), getattr(wrote, name), rtol=2e-3)


def test_a_runtime_with_very_many_figures_counts_where_it_is_asked_about(
    model: LatencyModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = model.parts["processors"]
    orin = known_devices()["jetson-agx-orin-64gb", "gpu"]
    crowded, other = ask(place=orin, runtime="tensorrt", precision="float16"), ask()
    with_all = {each: model.predict([each])[0].ms for each in (crowded, other)}
    assert crowded_runtimes(known.rows) == set()
    monkeypatch.setattr(module, "MAX_IDLE_FIGURES", 17)  # three devices with TensorRT have 18 figures
    (crowd,) = crowded_runtimes(known.rows)
    assert len(known.process_without([]).rows) == 42
    assert len(known.process_without([crowd]).rows) == 42 - 18
    without = model.predict([other])[0].ms
    assert without != with_all[other]
    assert without == pytest.approx(with_all[other], rel=0.1), "it says little of it"
    assert model.predict([crowded])[0].ms == with_all[crowded]
    monkeypatch.undo()
    assert model.predict([other])[0].ms == with_all[other], "what was left out once is not left out for ever"


def test_a_directory_takes_the_place_of_the_shipped_model(
    model: LatencyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(model, tmp_path)
    before = load_model().about
    monkeypatch.setenv("VLATOOL_LATENCY", str(tmp_path))
    assert load_model().about == model.about != before
    monkeypatch.delenv("VLATOOL_LATENCY")
    assert load_model().about == before


def test_a_directory_of_another_version_is_named(
    model: LatencyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(model, tmp_path)
    with np.load(tmp_path / "latency.npz") as stored:
        older = {name: stored[name][:, :8] if name.endswith(".keys") else stored[name] for name in stored.files}
    np.savez(tmp_path / "latency.npz", **older)
    monkeypatch.setenv("VLATOOL_LATENCY", str(tmp_path))
    with pytest.raises(DataError, match="it was fitted by another version of vlatool") as caught:
        load_model()
    assert "hwselect fit" in caught.value.fix


def test_an_npu_that_was_never_published_is_unknown(model: LatencyModel) -> None:
    other = replace(HAILO, device="hailo-99")
    asked = ask(place=other, runtime="hailort", precision="int8")
    (found,) = model.predict([asked])
    assert (found.regime, found.why) == ("unseen", module.UNKNOWN_NPU)
    assert model.predict([replace(asked, compute_unit=HAILO)])[0].known
    told = model.condition([(asked, 20.0)])
    assert told.predict([asked])[0].known, "once it was measured"


@pytest.mark.parametrize(
    "damage",
    ["absent", "empty", "cut", "no archive", "no JSON", "another file", "no array", "no part", "flipped", "a list"],
)
def test_a_directory_without_a_model_is_named(
    damage: str, model: LatencyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "fit"
    if damage != "absent":
        folder.mkdir()
    if damage not in ("absent", "empty"):
        write(model, folder)
    arrays, parameters = folder / "latency.npz", folder / "latency.json"
    if damage == "cut":
        arrays.write_bytes(arrays.read_bytes()[:-200])
    elif damage == "no archive":
        arrays.write_text("hello")
    elif damage == "no JSON":
        parameters.write_text("{")
    elif damage == "another file":
        parameters.write_text("[1]")
    elif damage == "no array":
        np.savez(arrays, a=np.zeros(3))
    elif damage == "no part":
        parameters.write_text('{"about": {}, "parts": {}}')
    elif damage == "a list":
        parameters.write_text('{"about": {}, "parts": []}')
    elif damage == "flipped":
        data = bytearray(arrays.read_bytes())
        data[200:400] = bytes(255 - byte for byte in data[200:400])
        arrays.write_bytes(data)
    monkeypatch.setenv("VLATOOL_LATENCY", str(folder))
    with pytest.raises(DataError, match=r"The latency model in .* cannot be read") as caught:
        load_model()
    assert str(folder) in caught.value.message
    assert "unset VLATOOL_LATENCY" in str(caught.value.fix)


def test_npus_are_asked_apart() -> None:
    assert part_of(ask()) == "processors"
    assert part_of(ask(place=HAILO)) == "npu"
    assert unknown_reason(ask(), published=True, device_known=True) == ""


# ---- the model that is shipped


def test_every_shipped_answer_lies_in_its_interval(load: Callable[..., Workload]) -> None:
    from vlatool.latency_model.board import candidates, outcomes

    asked = [way for name in profile_names() for way in candidates(load_profile(name), load())]
    found = outcomes(asked, load(), load_model())
    assert len(found) > 200
    known = [outcome.latency for outcome in found if outcome.latency.known]
    assert len(known) > len(found) / 4
    assert {latency.regime for latency in known} == {"known", "unseen"}
    for outcome in found:
        latency = outcome.latency
        if latency.known:
            assert 0 < latency.low <= latency.ms <= latency.high
            assert latency.high / latency.low <= math.exp(2 * MAX_HALF_INTERVAL) * 1.0001
        else:
            assert latency.why
            assert math.isnan(latency.ms)


def test_the_shipped_model_says_nothing_of_a_transformer_on_hailo(load: Callable[..., Workload]) -> None:
    from vlatool.latency_model.board import Candidate, outcomes

    way = Candidate(load_profile("raspberry-pi-5-hailo8"), "default", "hailort", "int8")
    latency = outcomes([way], load(traits=frozenset({"attention"})), load_model())[0].latency
    assert not latency.known
    assert "Hailo" in latency.why


def test_the_shipped_model_was_fitted_on_thousands_of_figures() -> None:
    assert load_model().about["figures"] > 2000
    assert load_model() is load_model(), "read once"
    for part, process in load_model().parts.items():
        assert np.isfinite(process.logs).all(), part
        assert set(load_model().conformal[part]) == {"known", "unseen", "calibrated"}
