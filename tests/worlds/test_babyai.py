from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from vlatool.errors import UsageError
from vlatool.messages import pixels
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.worlds import World, open_world


def run(world: Any, seconds: float, linear: float = 0.0, angular: float = 0.0) -> list[tuple[str, Any]]:
    reports = []
    for _ in range(round(seconds * 10)):
        world.obey("/cmd_vel", Twist(Vector3(linear), Vector3(z=angular)))
        world.advance(0.1)
        reports += world.reports()
    return reports


def newest(reports: list[tuple[str, Any]], topic: str) -> Any:
    return [message for name, message in reports if name == topic][-1]


def turn_left(world: Any) -> list[tuple[str, Any]]:
    """Turn by 90 degrees in a second and a bit."""
    start = world.truth()["pose"][2]
    while (left := start + math.pi / 2 - world.truth()["pose"][2]) % (2 * math.pi) > 0.02:
        run(world, 0.1, 0.0, min(1.0, 2.0 * math.remainder(left, 2 * math.pi)))
    return run(world, 0.5)


def test_the_camera_shows_what_minigrid_draws_after_the_same_moves():
    import minigrid  # noqa: F401 - its levels are registered by this
    from minigrid.wrappers import RGBImgPartialObsWrapper

    world = open_world("babyai", slip=0.0)
    assert isinstance(world, World)
    theirs = RGBImgPartialObsWrapper(gymnasium.make("BabyAI-GoToLocalS6N3-v0", disable_env_checker=True), tile_size=8)
    for seed in (1, 2):
        world.reset(seed)
        expected = theirs.reset(seed=seed)[0]
        reports = run(world, 0.4)
        assert newest(reports, "/vln/instruction").data == expected["mission"]
        for _ in range(3):
            assert np.array_equal(pixels.rgb(newest(reports, "/camera/color/image_raw")), expected["image"])
            reports = turn_left(world)
            expected = theirs.step(theirs.unwrapped.actions.left)[0]


def test_cells_with_an_object_and_walls_stop_the_base_and_depth_says_how_far_they_are():
    world = open_world("babyai", slip=0.0)
    world.reset(3)
    ahead = pixels.depth_m(newest(run(world, 0.4), "/camera/depth/image_raw"))[0, 0]
    assert (ahead - 0.5) % 1.0 == pytest.approx(0.0, abs=0.03)
    x, y, _ = world.truth()["pose"]
    run(world, (ahead + 1.0) / 0.3, 0.3)
    moved = math.hypot(world.truth()["pose"][0] - x, world.truth()["pose"][1] - y)
    assert moved == pytest.approx(ahead, abs=0.03)
    assert world.truth()["collisions"] == 1


def test_it_has_arrived_where_minigrid_says_so_and_the_base_stands():
    world = open_world("babyai", slip=0.0)
    world.reset(1)
    column, row = (int(value) for value in world._level.instrs.desc.obj_poss[0])
    found = []
    for heading in range(4):
        yaw = heading * math.pi / 2
        cell = (column - round(math.cos(yaw)), row + round(math.sin(yaw)))
        if world._is_blocked(cell):
            continue
        for turn, aside in ((0.0, 0.0), (0.2, 0.1), (0.4, 0.0), (0.0, 0.3), (math.pi / 2, 0.0)):
            world._pose = (cell[0] + 0.5 + aside, -cell[1] - 0.5, yaw + turn)
            reports = run(world, 0.1)
            found.append((turn, aside, world.truth()["arrived"]))
            assert newest(reports, "/vln/arrived").data == world.truth()["arrived"]
        world._pose = (cell[0] + 0.5, -cell[1] - 0.5, yaw)
        run(world, 0.1, 0.0, 0.5)
        assert not world.truth()["arrived"]
        run(world, 0.5)
    assert len(found) >= 10
    assert all(arrived == ((turn, aside) in ((0.0, 0.0), (0.2, 0.1))) for turn, aside, arrived in found)


def test_unknown_levels_and_knobs_are_refused():
    with pytest.raises(UsageError, match="no level 'GoToMoon'"):
        open_world("babyai", task="GoToMoon")
    with pytest.raises(UsageError, match="allowed"):
        open_world("babyai", slip=2.0)
    with pytest.raises(UsageError, match="Twist on /cmd_vel"):
        open_world("babyai").obey("/joint_command", Twist())
