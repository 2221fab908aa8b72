"""What environments tell of the robot's body: right numbers, or none and the reason."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.episodes.body import Body, same_unit_elements
from vlatool.motion.measure import measure_episode

ACTION = TensorSpec("action", (1, 2, 4), unit=("m", "m", "m", "1"), labels=("x", "y", "z", "gripper"))
SPEC = PolicySpec((TensorSpec("state", (1, 4)),), (ACTION,), control_hz=10.0, chunk=2)
STEPS = 6


def played(infos: list[Any]) -> Body:
    """A body after an episode whose infos these are, that of the reset first."""
    body = Body(SPEC)
    body.look(infos[0])
    for step, info in enumerate(infos[1:]):
        body.add_action(np.full(4, step, np.float32), step % 2 == 0)
        body.look(info)
    return body


def told(**series: Any) -> list[dict[str, Any]]:
    """The infos of an episode: what is a list differs from step to step."""
    return [{name: value[at] if isinstance(value, list) else value for name, value in series.items()}
            for at in range(STEPS + 1)]  # fmt: skip


def test_all_that_is_told_is_kept():
    places = [np.array([0.1 * step, 0.0, 0.0]) for step in range(STEPS + 1)]
    body = played(told(position=places, joints=[[step, 0.0] for step in range(STEPS + 1)], heading=0.5, gripper=1,
                       collision=[None, False, True, False, False, False, False], shortest_path=0.3))  # fmt: skip
    track = body.track()
    assert not body.refused
    assert (track.hz, len(track), track.position.shape, track.joints.shape) == (10.0, 6, (7, 3), (7, 2))
    assert track.collision.tolist() == [False, True, False, False, False, False]
    assert track.fresh.tolist() == [True, False] * 3
    assert (track.alike, track.grip, track.shortest) == ((0, 1, 2), 3, 0.3)
    found = measure_episode(track)
    assert found["path_length"] == pytest.approx(0.6)
    assert found["detour"] == pytest.approx(2.0)
    assert found["collisions"] == 1.0


def test_nothing_told_leaves_the_actions():
    for infos in (told(), [None] * (STEPS + 1), ["text"] * (STEPS + 1), [{}, *told()[1:]]):
        body = played(infos)
        assert not body.refused
        assert set(measure_episode(body.track())) == {
            "task_time",
            "action_rate",
            "seam_jump",
            "reversals",
            "gripper_flips",
        }


def test_a_reset_that_tells_nothing_begins_with_the_first_step():
    infos = told(position=[np.array([float(step)]) for step in range(STEPS + 1)])
    track = played([{}, *infos[1:]]).track()
    assert track.position.shape == (6, 1)


def test_the_rate_is_that_of_the_clock_of_the_environment():
    assert played(told(time=[0.05 * step for step in range(STEPS + 1)])).track().hz == pytest.approx(20.0)
    assert played(told()).track().hz == 10.0


WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "NaN in one step": ({"position": [[0.0, 1.0]] * 3 + [[np.nan, 1.0]] + [[0.0, 1.0]] * 3}, "position", "NaN"),
    "NaN throughout": ({"position": [float("nan")] * 3}, "position", "shape|NaN"),
    "infinite": ({"joints": (0.0, float("inf"))}, "joints", "infinity"),
    "too large": ({"position": (1e12, 0.0)}, "position", "1e9"),
    "text": ({"position": "left"}, "position", "str and no number"),
    "a mapping": ({"position": {"x": 1.0}}, "position", "dict and no number"),
    "an object": ({"joints": object()}, "joints", "object and no number"),
    "ragged": ({"joints": ((1.0, 2.0), (3.0,))}, "joints", "no number"),
    "complex": ({"position": np.array([1j, 0.0])}, "position", "ndarray and no number, or not a real one"),
    "four axes": ({"position": (0.0,) * 4}, "position", r"shape \[4\]"),
    "a pose matrix": ({"position": np.eye(4)}, "position", r"shape \[4, 4\]"),
    "nothing": ({"position": ()}, "position", r"shape \[0\]"),
    "a scalar position": ({"position": 1.0}, "position", r"shape \[\]"),
    "too many joints": ({"joints": tuple(range(65))}, "joints", r"shape \[65\]"),
    "a changing shape": ({"position": [(0.0, 0.0)] * 3 + [(0.0, 0.0, 0.0)] * 4}, "position", "changes from"),
    "told now and then": ({"position": [(0.0, 0.0), None, None, (0.0, 0.0), None, None, None]}, "position", "2 of 7"),
    "told from the third step on": ({"joints": [None] * 3 + [(1.0,)] * 4}, "joints", "4 of 7"),
    "two headings": ({"heading": (0.0, 1.0)}, "heading", "one number"),
    "a gripper in words": ({"gripper": "open"}, "gripper", "str"),
    "collisions in words": ({"collision": "no"}, "collision", "str"),
    "a negative shortest path": ({"shortest_path": -1.0}, "shortest_path", "from 0"),
    "a shortest path of NaN": ({"shortest_path": float("nan")}, "shortest_path", "NaN"),
    "a clock that stands": ({"time": 1.0}, "time", "alike"),
    "a clock that changes its pace": ({"time": [0.0, 0.1, 0.2, 0.5, 0.6, 0.7, 0.8]}, "time", "alike"),
    "a clock that runs backwards": ({"time": [-float(step) for step in range(7)]}, "time", "above 0"),
    "a clock that goes back": ({"time": [0.0, 0.1, 0.2, 0.1, 0.2, 0.3, 0.4]}, "time", "alike"),
    "a clock that is told now and then": ({"time": [0.0, None, 0.2, None, 0.4, None, 0.6]}, "time", "4 of 7"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_gives_no_number_and_a_reason(case: str):
    series, name, why = WRONG[case]
    series = {key: value * 3 if isinstance(value, list) and len(value) == 3 else value for key, value in series.items()}
    body = played(told(**series))
    found = measure_episode(body.track())
    assert list(body.refused) == [name]
    assert body.refused[name]
    assert re.search(why, body.refused[name]), body.refused
    assert set(found) == {"task_time", "action_rate", "seam_jump", "reversals", "gripper_flips"}
    assert found["task_time"] == pytest.approx(STEPS / 10.0), "the rate of the spec"
    assert np.isfinite(list(found.values())).all()


def test_an_episode_of_one_step():
    body = Body(SPEC)
    body.look({"position": (0.0, 0.0)})
    body.add_action(np.zeros(4, np.float32), True)
    body.look({"position": (3.0, 4.0)})
    found = measure_episode(body.track())
    assert found["task_time"] == pytest.approx(0.1)
    assert found["path_length"] == pytest.approx(5.0)
    assert "jerk" not in found


def test_elements_of_an_action_that_share_a_unit():
    assert same_unit_elements(TensorSpec("a", (1, 1, 3), unit="rad")) == (0, 1, 2)
    assert same_unit_elements(TensorSpec("a", (1, 1, 4), unit=("m", "rad", "rad", "1"))) == (1, 2)
    assert same_unit_elements(TensorSpec("a", (1, 2), kind="discrete", labels=("l", "r"))) == ()
    assert TensorSpec("a", (1, 1, 2), labels=("x", "Gripper effort")).gripper == 1
    assert TensorSpec("a", (1, 1, 2), labels=("left_gripper", "right_gripper")).gripper is None
