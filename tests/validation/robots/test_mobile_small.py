"""The small form of ``mobile.py``: a few episodes of each kind."""

from __future__ import annotations

import ctypes.util

import pytest
from _full import small_or_full
from mobile import FOLLOWERS, HOSTILE, collision_episode, step_episode

pytestmark = pytest.mark.skipif(
    not any(map(ctypes.util.find_library, ("EGL", "OSMesa"))),
    reason="neither EGL nor OSMesa is installed: nothing renders",
)


@pytest.mark.parametrize("name", FOLLOWERS)
def test_heading_and_distance_are_right_after_three_seconds_and_it_rests_when_the_target_is_gone(name: str):
    for seed in range(small_or_full(1, 100)):
        right, rests, _ = step_episode(name, seed)
        assert right
        assert rests


@pytest.mark.parametrize("seed", range(small_or_full(1, len(HOSTILE))))
def test_no_collision_and_no_fall_behind_the_safety_monitor_in_hostile_rooms(seed: int):
    found = collision_episode("roi-follower", seed, True, None, seconds=2.0)
    assert (found["collisions"], found["falls"]) == (0, 0)
