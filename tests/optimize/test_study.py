"""Trials in a study: what is tried next, what several processes share, and what a study may not say."""

from __future__ import annotations

import json
import math
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from vlatool.errors import DataError, UsageError
from vlatool.optimize import study as study_module
from vlatool.optimize.space import FLOAT32, Shape, Space
from vlatool.optimize.study import Study, Tried, worker

INT8: Any = ({"quantize.static_int8": {}},)
SPACE = Space((1.0, 0.55), 4, 1, {"static_int8": INT8, FLOAT32: ()}, ({"distill.policy": {}},))


def opened(url: str, name: str = "tiny-1", space: Space = SPACE) -> Study:
    study = Study(url, name, 0.01, 0)
    study.begin(space)
    return study


@pytest.fixture(params=["journal", "sqlite"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "trials.journal") if request.param == "journal" else f"sqlite:///{tmp_path / 'trials.db'}"


def drained(study: Study, trials: int) -> list[Shape]:
    """Run trials whose speed-up and drop follow from their shape."""
    shapes = []
    while (asked := study.ask(trials)) is not None:
        number, shape = asked
        shapes.append(shape)
        study.tell(number, Tried(shape, 8 / (shape.width * shape.blocks), 0.002 * (4 - shape.blocks), 60.0))
    return shapes


def test_first_come_the_shapes_of_the_space_then_others_none_of_them_twice(url: str) -> None:
    study = opened(url)
    shapes = drained(study, 8)
    assert shapes[:4] == list(SPACE.first())
    assert len(set(shapes)) == len(shapes) == 8
    assert [tried.shape for tried in study.ended_trials()] == shapes
    assert all(tried.training_s == 60 and not tried.elsewhere for tried in study.ended_trials())


def test_trials_end_when_the_whole_space_was_tried(tmp_path: Path) -> None:
    small = Space((1.0, 0.55), 2, 1, SPACE.quantized, SPACE.recover)
    assert len(drained(opened(str(tmp_path / "trials"), space=small), 1000)) == 2 * 2 * 2


def test_a_study_goes_on_where_it_was(url: str) -> None:
    first = drained(opened(url), 3)
    again = opened(url)
    assert drained(again, 3) == []
    more = drained(again, 6)
    assert len({*first, *more}) == 6
    assert drained(opened(url), 6) == []


def test_the_same_answers_lead_to_the_same_trials(tmp_path: Path) -> None:
    one, two = (drained(opened(str(tmp_path / name)), 9) for name in ("one", "two"))
    assert one == two


def test_two_machines_share_trials(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    here = opened(url)
    asked = here.ask(5)
    assert asked is not None
    monkeypatch.setattr(study_module, "worker", lambda: "elsewhere/1/2")
    there = opened(url)
    shapes = drained(there, 5)
    assert len(shapes) == 4, "one of five is under way here"
    assert asked[1] not in shapes
    assert there.under_way() == 1
    assert all(tried.elsewhere for tried in here.ended_trials())
    here.tell(asked[0], Tried(asked[1], 2.0, 0.0))
    assert len(there.ended_trials()) == 5


@pytest.mark.parametrize("gone_process", [2**22 + 1, 0], ids=["no process", "another process has its number"])
def test_what_a_killed_process_had_under_way_is_tried_again(
    url: str, gone_process: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, process, began = worker().split("/")
    gone = opened(url)
    who = f"{machine}/{gone_process}/{began}" if gone_process else f"{machine}/{process}/1"
    monkeypatch.setattr(gone, "_worker", who)
    asked = gone.ask(4)
    assert asked is not None
    shapes = drained(opened(url), 4)
    assert shapes[0] == asked[1], "it is gone on with before others begin"
    assert len(set(shapes)) == len(shapes) == 4


def test_what_another_machine_has_under_way_is_left_to_it(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    other = opened(url)
    monkeypatch.setattr(other, "_worker", f"0-other/{2**22 + 1}/1")
    asked = other.ask(3)
    assert asked is not None
    shapes = drained(opened(url), 3)
    assert asked[1] not in shapes
    assert len(shapes) == 2


def test_what_moves_worse_than_allowed_is_kept_with_the_reason(url: str) -> None:
    study = opened(url)
    number, shape = study.ask(9) or pytest.fail("no trial")
    study.tell(number, Tried(shape, 3.0, 0.0, refused="it needs 1.11x the steps", miss=0.05))
    drained(study, 9)
    assert [each.refused for each in study.ended_trials()] == ["it needs 1.11x the steps", *8 * [""]]
    constraints = [trial.constraints["moves"] for trial in study._trials() if "moves" in trial.constraints]
    assert constraints == [0.05, *8 * [0.0]]


def test_what_could_not_be_made_says_why(url: str) -> None:
    study = opened(url)
    for note, drop in (("no room", math.inf), ("", math.nan), ("", math.inf)):
        number, shape = study.ask(9) or pytest.fail("no trial")
        study.tell(number, Tried(shape, 1.0, drop, note=note))
    assert [(tried.note, tried.speedup) for tried in study.ended_trials()] == [
        ("no room", 0), *2 * [("its accuracy could not be measured", 0)]
    ]  # fmt: skip
    assert len(drained(study, 5)) == 2, "they count"


def test_all_quantize_as_the_first_one_found(url: str) -> None:
    assert Study(url, "tiny-1", 0.01, 0).agree_on({"static_int8": INT8}) == {"static_int8": INT8, FLOAT32: ()}
    other: Any = {"dynamic_int8": ({"quantize.dynamic_int8": {}},)}
    assert Study(url, "tiny-1", 0.01, 0).agree_on(other) == {"static_int8": INT8, FLOAT32: ()}
    assert Study(url, "tiny-2", 0.01, 0).agree_on(other) == {**other, FLOAT32: ()}


@pytest.mark.parametrize(
    "held",
    [
        7,
        [["a"]],
        [["a", [{"quantize.nothing": {}}]]],
        [["a", [{"quantize.static_int8": {"bits": 99}}]]],
        [["a", [{"export.onnx": {}}]]],
        [["a", [{"distill.policy": {}}]]],
        [["a", []]],
        [["a", ["quantize.static_int8"]]],
    ],
    ids=str,
)
def test_a_study_that_says_something_else_of_quantization_is_refused(tmp_path: Path, held: Any) -> None:
    study = Study(str(tmp_path / "trials"), "tiny-1", 0.01, 0)
    study._study.set_user_attr("quantized", held)
    with pytest.raises(DataError, match="quanti"):
        study.agree_on({"static_int8": INT8})


@pytest.mark.parametrize(
    ("params", "values"),
    [
        ({"width": 0.55, "blocks": 9}, (1.0, 0.0)),
        ({"width": 0.55}, (1.0, 0.0)),
        ({"width": 0.55, "blocks": 1, "steps": 1, "quantized": "float32", "more": 1}, (1.0, 0.0)),
        ({"width": 0.55, "blocks": 9, "steps": 1, "quantized": "float32"}, (1.0, 0.0)),
        ({"width": 0.55, "blocks": 1, "steps": 1, "quantized": "float32"}, (-1.0, 0.0)),
    ],
    ids=str,
)
def test_trials_that_are_not_of_the_policy_are_refused(tmp_path: Path, params: Any, values: Any) -> None:
    import optuna

    study = opened(str(tmp_path / "trials"))
    kinds = {
        "width": optuna.distributions.FloatDistribution(0, 1),
        "quantized": optuna.distributions.CategoricalDistribution(["float32", "static_int8"]),
    }
    counted = optuna.distributions.IntDistribution(1, 9)
    trial = optuna.trial.create_trial(
        params=params, values=values, distributions={name: kinds.get(name, counted) for name in params}
    )
    study._study.add_trial(trial)
    with pytest.raises(DataError, match="Trial 4 of the study"):
        study.ended_trials()


def test_a_database_that_is_damaged_meanwhile_is_named(tmp_path: Path) -> None:
    study = opened(f"sqlite:///{tmp_path / 'trials.db'}")
    number, shape = study.ask(4) or pytest.fail("no trial")
    with sqlite3.connect(tmp_path / "trials.db") as connection:
        connection.execute("drop table trials")
    connection.close()
    for use in (lambda: study.ask(4), lambda: study.tell(number, Tried(shape, 1.0, 0.0)), study.under_way):
        with pytest.raises(UsageError, match=r"The study .*trials\.db cannot be used"):
            use()


def test_no_message_tells_a_password() -> None:
    with pytest.raises(UsageError, match="cannot be used") as caught:
        opened("postgresql://me:secret@127.0.0.1:1/none")
    assert "secret" not in str(caught.value)


def test_another_space_under_the_same_name_is_refused(url: str) -> None:
    drained(opened(url), 2)
    other = opened(url, space=Space((1.0, 0.7), 4, 1, {FLOAT32: ()}, SPACE.recover))
    with pytest.raises(DataError, match="another space"):
        drained(other, 9)


def _folder(path: Path) -> str:
    path.mkdir()
    return str(path)


def _text(path: Path) -> str:
    path.write_text("not a journal\n" * 3)
    return str(path)


def _json(path: Path) -> str:
    path.write_text(json.dumps({"op_code": 99, "worker_id": "a"}) + "\n")
    return str(path)


def _database(path: Path) -> str:
    path.write_bytes(b"not a database, but long enough to be looked at" * 40)
    return f"sqlite:///{path}"


def _other_tables(path: Path) -> str:
    with sqlite3.connect(path) as connection:
        connection.execute("create table studies (something text)")
    connection.close()
    return f"sqlite:///{path}"


@pytest.mark.parametrize(
    "wrong",
    [
        _folder,
        _text,
        _json,
        _database,
        _other_tables,
        lambda path: str(path / "missing" / "trials"),
        lambda path: f"sqlite:///{path}/missing/trials.db",
        lambda path: "nothing://here",
        lambda path: "sqlite://:::",
        lambda path: "postgresql://127.0.0.1:1/none",
    ],
    ids=["folder", "text", "json", "database", "tables", "missing", "missing-db", "scheme", "url", "nobody"],
)
def test_a_study_that_cannot_be_opened_is_named(tmp_path: Path, wrong: Any) -> None:
    url = wrong(tmp_path / "trials")
    with pytest.raises((UsageError, DataError), match=r"The study .* cannot be used|is not a study"):
        opened(url)


def test_what_a_study_says_is_nobodys_measurement(url: str) -> None:
    """Whoever reaches a study can write into it: another speed-up, and the name of this process as the worker."""
    here = opened(url)
    (number, shape), (forged, other) = here.ask(9), here.ask(9)
    here.tell(number, Tried(shape, 2.0, 0.01, note=""))
    opened(url).tell(forged, Tried(other, 99.0, 0.0))
    assert {tried.speedup: tried.elsewhere for tried in here.ended_trials()} == {2.0: False, 99.0: True}
    assert all(tried.elsewhere for tried in opened(url).ended_trials()), (
        "another run of the same command made none of them"
    )
