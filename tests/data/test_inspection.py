"""What is said of a dataset, from its steps alone."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.data import Steps, inspect_steps
from vlatool.data._inspection_page import inspection_lines

COUNT = 40
TIMES = np.tile(np.arange(20) / 10, 2)


def steps(times: Any = TIMES, **columns: Any) -> Steps:
    rows = np.arange(COUNT * 2, dtype=np.float32).reshape(COUNT, 2)
    own = {"state": rows, "action": rows + 1, **columns}
    return Steps(Path("data"), own, np.repeat([3, 4], 20), times, "action", 10.0, np.repeat([0, 1], 20))


def test_a_dataset_without_faults_has_no_findings():
    found = inspect_steps(steps(), "made")
    assert (found.episodes, found.steps, found.tasks, found.lengths) == (2, COUNT, 2, (20, 20))
    assert found.measured_hz == pytest.approx(10)
    assert (found.findings, found.gap_count) == ((), 0)
    assert [(each.name, each.shape, each.low, each.high) for each in found.columns] == [
        ("state", (2,), 0, 79), ("action", (2,), 1, 80)]  # fmt: skip
    assert inspection_lines(found)[1] == "  episodes   2, 40 steps, 2 tasks: 20 to 20 steps each, 20 in the middle"


ROWS = np.arange(COUNT)


@pytest.mark.parametrize(
    ("times", "sentence"),
    [
        (TIMES + (ROWS >= 7) * 0.5, "1 gap: time goes on by 0.600 s before step 7 of episode 3, otherwise by 0.100 s"),
        (
            TIMES - (ROWS >= 25) * 0.1,
            "1 gap: time goes on by 0.000 s before step 5 of episode 4, otherwise by 0.100 s",
        ),
        (
            TIMES - (ROWS >= 30) * 2,
            "1 gap: time goes on by -1.900 s before step 10 of episode 4, otherwise by 0.100 s",
        ),
        (
            np.where(ROWS == 30, 0, TIMES),
            "2 gaps: time goes on by 1.100 s before step 11 of episode 4, otherwise by 0.100 s",
        ),
        (TIMES / 3, "the dataset names 10 Hz; its time stamps are those of 30 Hz"),
    ],
    ids=["a hole in both", "still", "back", "a spike", "rate"],
)
def test_gaps_and_rates_are_found(times: Any, sentence: str):
    found = inspect_steps(steps(times), "made").findings
    assert found == (sentence,)


def test_values_that_are_not_finite_and_those_that_never_change_are_found():
    state = np.random.default_rng(0).normal(size=(COUNT, 3))
    state[[3, 9], 1], state[:, 2] = np.nan, 7
    found = inspect_steps(steps(state=state), "made").findings
    assert found == ("'state' is not finite in 2 steps", "'state' never changes in element 2")


@pytest.mark.parametrize(("slope", "constant", "drifts"), [(0.05, 0.0, True), (0.0, 0.2, False), (0.005, 0.0, False)])
def test_a_camera_whose_lag_changes_drifts(slope: float, constant: float, drifts: bool):
    whole = replace(steps(), stamps={"state": TIMES * (1 + slope) + constant})
    found = [each for each in inspect_steps(whole, "made").findings if "the lag of 'state' changes" in each]
    assert bool(found) is drifts


def test_columns_of_each_type_have_their_range():
    columns = {kind: np.arange(COUNT).astype(kind) for kind in ("uint8", "int64", "float16", "bool")}
    found = inspect_steps(steps(**columns, text=np.array(["go"] * COUNT), empty=np.full(COUNT, np.nan)), "made")
    ends = {each.name: (each.low, each.high, each.not_finite) for each in found.columns}
    assert ends["uint8"] == ends["int64"] == ends["float16"] == (0, COUNT - 1, 0)
    assert (ends["bool"], ends["text"], ends["empty"]) == ((0, 1, 0), (None, None, 0), (None, None, COUNT))


def test_a_short_episode_and_a_lack_of_actions_are_mentioned():
    episodes = np.repeat(np.arange(4), [13, 13, 13, 1])
    found = inspect_steps(replace(steps(), episodes=episodes, action="", times=None), "made")
    assert found.measured_hz is None
    assert found.findings[0] == "episode 3 has 1 step; half of them have 13 or more"
    assert "no column of actions" in found.findings[1]
