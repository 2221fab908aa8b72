from __future__ import annotations

import numpy as np
import pytest
from _full import small_or_full
from _mobile_feed import Feed, camera_info, depth_image, speeds
from _tutorial_laws import ObjectFollower

from vlatool.controllers.roi_follower import RoiFollower
from vlatool.errors import UsageError
from vlatool.messages.sensor_msgs import Image, RegionOfInterest

MESSAGES = small_or_full(1_000, 100_000)
WIDTH, HEIGHT = 32, 24


def test_the_law_is_that_of_the_tutorial():
    random, feed = np.random.default_rng(2), Feed()
    for count in range(MESSAGES):
        if count % 100 == 0:
            settings = {"goal_z": random.uniform(0.3, 1.5), "scale_roi": random.uniform(0.3, 1.0)}
            settings |= {"slow_down_factor": random.uniform(0, 1), "z_threshold": random.uniform(0, 0.2)}
            controller, law = RoiFollower(**settings, lost_s=1e9), ObjectFollower(**settings)
            state = controller.start()
        messages, expected = {}, None
        if random.random() < 0.8:
            x, y = int(random.integers(WIDTH - 1)), int(random.integers(HEIGHT - 1))
            box = (x, y, int(random.integers(1, WIDTH - x + 1)), int(random.integers(1, HEIGHT - y + 1)))
            depth = random.normal(random.uniform(0.3, 1.7), 0.1, (HEIGHT, WIDTH)).astype(np.float32)
            depth[random.random(depth.shape) < random.choice([0.0, 0.2, 1.0])] = np.nan
            roi = RegionOfInterest(x_offset=box[0], y_offset=box[1], width=box[2], height=box[3])
            messages = {"roi": roi, "depth": depth_image(depth)}
            expected = law.seen(box, depth, WIDTH)
        snapshot = feed.snapshot(count * 0.1, camera_info=camera_info(WIDTH, HEIGHT), **messages)
        command, state = controller.step(snapshot, state)
        assert speeds(command) == pytest.approx(expected or law.lost(), abs=1e-9)


def follow(depth: np.ndarray, **settings: float) -> tuple[RoiFollower, Feed, object, object]:
    feed, controller = Feed(), RoiFollower(**settings)
    roi = RegionOfInterest(x_offset=11, y_offset=8, width=10, height=8)
    snapshot = feed.snapshot(0.0, camera_info=camera_info(WIDTH, HEIGHT), roi=roi, depth=depth_image(depth))
    return controller, feed, *controller.step(snapshot, controller.start())


def test_it_keeps_three_quarters_of_a_metre_from_the_middle_of_the_region():
    depth = np.full((HEIGHT, WIDTH), 5.0, np.float32)
    depth[8:16, 11:21] = 1.15
    assert speeds(follow(depth)[2]) == pytest.approx((0.2, 0.0))
    depth[8:16, 11:21] = 0.79
    assert speeds(follow(depth)[2]) == (0.0, 0.0)


def test_it_stands_half_a_second_after_the_target_is_gone():
    controller, feed, command, state = follow(np.full((HEIGHT, WIDTH), 1.4, np.float32))
    assert speeds(command)[0] == pytest.approx(0.3)
    found = []
    for step in range(1, 8):
        command, state = controller.step(feed.snapshot(step * 0.1), state)
        found.append(speeds(command)[0])
    assert found[:3] == pytest.approx([0.24, 0.192, 0.1536])
    assert found[-2:] == [0.0, 0.0]


def test_it_does_not_drive_by_a_depth_image_that_came_too_long_ago():
    controller, feed, command, state = follow(np.full((HEIGHT, WIDTH), 1.4, np.float32))
    assert speeds(command)[0] == pytest.approx(0.3)
    for step in range(1, 31):
        roi = RegionOfInterest(x_offset=11, y_offset=8, width=10, height=8)
        command, state = controller.step(feed.snapshot(step * 0.1, roi=roi), state)
    assert speeds(command)[0] < 0.01
    assert command.status == "turning: depth 3.0 s old"


def test_depth_of_nothing_but_nan_and_of_a_wrong_encoding_does_not_drive():
    assert speeds(follow(np.full((HEIGHT, WIDTH), np.nan, np.float32))[2]) == (0.0, 0.0)
    controller, feed, _, state = follow(np.full((HEIGHT, WIDTH), np.nan, np.float32))
    roi = RegionOfInterest(x_offset=0, y_offset=0, width=4, height=4)
    bad = Image(height=1, width=1, encoding="jpeg", step=1, data=np.zeros(1, np.uint8))
    command, _ = controller.step(feed.snapshot(0.1, roi=roi, depth=bad), state)
    assert speeds(command)[0] == 0.0
    assert "jpeg" in command.status


@pytest.mark.parametrize("settings", [{"scale_roi": 1.5}, {"slow_down_factor": -0.1}, {"min_linear_speed": 1.0}])
def test_settings_out_of_range_are_refused(settings: dict[str, float]):
    with pytest.raises(UsageError, match="allowed"):
        RoiFollower(**settings)
