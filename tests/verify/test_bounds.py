"""What right logs have for a change by chance, in logs of one episode and of several."""

from __future__ import annotations

import numpy as np
import pytest

from vlatool.verify._bounds import MIN_EVIDENCE, Bounds, Nulls, episode_parts, task_parts, upper_bound
from vlatool.verify._search import KINDS, Tables
from vlatool.verify._series import Series


def bounds(value: float, rows: float = 100.0) -> Bounds:
    return Bounds({size: {"state": dict.fromkeys(KINDS, value * size**0.5)} for size in (1, 2, 4)}, rows)


@pytest.mark.parametrize(("rows", "needed"), [
    (50, MIN_EVIDENCE), (100, MIN_EVIDENCE), (150, MIN_EVIDENCE * 2**0.5), (200, MIN_EVIDENCE * 2**0.5),
    (400, MIN_EVIDENCE * 2), (1600, MIN_EVIDENCE * 4),
])  # fmt: skip
def test_what_is_needed_grows_with_the_root_of_the_episodes(rows, needed):
    assert bounds(MIN_EVIDENCE).threshold(rows)["state"]["negated"] == pytest.approx(needed)


def test_what_exceeds_chance_grows_with_the_rows_beyond_the_longest_that_was_judged():
    assert bounds(20.0).threshold(800)["state"]["negated"] == pytest.approx(
        2 * MIN_EVIDENCE * 2**0.5 + 2 * (40 - 2 * MIN_EVIDENCE)
    )


def test_delays_need_as_much_as_in_new_tasks():
    found = bounds(7.0).with_delays_of(bounds(30.0)).threshold(100)["state"]
    assert found["delayed"] == 30
    assert {found[kind] for kind in KINDS if kind != "delayed"} == {7.0}


def series(tasks: int, episodes: int, rows: int = 60) -> Series:
    numbers = np.repeat(np.arange(tasks * episodes), rows)
    return Series({"state": np.zeros((len(numbers), 1))}, numbers, numbers // episodes)


def test_tasks_are_left_out_whole_and_episodes_where_others_of_the_task_are_left():
    whole = series(4, 3)
    for out, logs in task_parts(whole):
        assert not {*whole.groups[out]} & {*whole.groups[~out]}
        assert len(logs) == 3
    parts = list(episode_parts(whole))
    assert len(parts) == 3
    assert sorted(number for _, logs in parts for log in logs for number in log) == list(range(12))
    for out, _ in parts:
        assert {*whole.groups[out]} == {*whole.groups[~out]}


def test_a_task_of_one_episode_is_never_left_out_as_a_known_one():
    assert list(episode_parts(series(5, 1))) == []


def test_short_episodes_are_judged_together():
    (_, logs), *_ = task_parts(series(4, 6, rows=20))
    assert logs == [[0, 1, 2], [3, 4, 5]]


def test_evidence_of_several_episodes_is_that_of_all():
    """An episode for the sign, and two against it: alone it has evidence, together they have none."""

    def tables(gain: float) -> Tables:
        found = {delay: np.zeros((18, 1, 1)) for delay in range(-3, 4)}
        for table in found.values():
            table[0] = -gain
        return Tables(found)

    nulls = Nulls()
    nulls.add([{"state": tables(gain)} for gain in (20.0, -30.0, -30.0)], ())
    assert max(nulls.found[1, "state", "negated"]) == pytest.approx(17)
    assert max(nulls.found[2, "state", "negated"]) == 0
    assert {size for size, *_ in nulls.found} == {1, 2}


def test_the_bound_is_above_all_right_episodes():
    assert upper_bound([0.0] * 20) == pytest.approx(np.log(1000))
    assert upper_bound([0.0, 3.0, 5.0, 20.0]) > 20
    assert upper_bound([]) > upper_bound([0.0] * 20)
