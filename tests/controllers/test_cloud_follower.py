from __future__ import annotations

import numpy as np
import pytest
from _full import small_or_full
from _mobile_feed import Feed, speeds
from _tutorial_laws import CloudFollower as Law

from vlatool.controllers.cloud_follower import CloudFollower
from vlatool.messages.clouds import points_message
from vlatool.messages.sensor_msgs import PointCloud2

MESSAGES = small_or_full(1_000, 100_000)


def test_the_law_is_that_of_the_tutorial():
    random, feed = np.random.default_rng(3), Feed()
    for count in range(MESSAGES):
        if count % 100 == 0:
            settings = {"goal_z": random.uniform(0.3, 1.0), "x_scale": random.uniform(0, 4)}
            settings |= {"slow_down_factor": random.uniform(0, 1), "min_y": random.uniform(-0.5, 0)}
            controller, law = CloudFollower(**settings, lost_s=1e9), Law(**settings)
            state = controller.start()
        points = random.normal(0, 1, (int(random.integers(0, 40)), 3)) * (0.15, 0.3, 0.1)
        points = (points + random.normal(0, 0.05, 3) + (0, 0, random.uniform(0.3, 1.2))).astype(np.float32)
        points[random.random(len(points)) < 0.1] = np.nan
        command, state = controller.step(feed.snapshot(count * 0.1, cloud=points_message(points)), state)
        assert speeds(command) == pytest.approx(law.seen(points), abs=1e-9)


def test_an_empty_cloud_and_none_at_all_end_in_standing():
    feed, controller = Feed(), CloudFollower()
    far = points_message(np.array([[0.0, 0.0, 1.0]] * 5))
    command, state = controller.step(feed.snapshot(0.0, cloud=far), controller.start())
    assert speeds(command) == pytest.approx((0.3, 0.0))
    for step in range(1, 7):
        message = {"cloud": points_message(np.zeros((0, 3)))} if step < 3 else {}
        command, state = controller.step(feed.snapshot(step * 0.1, **message), state)
    assert speeds(command) == (0.0, 0.0)
    assert command.status == "standing: no new cloud"


def test_a_cloud_without_coordinates_is_a_status():
    feed, controller = Feed(), CloudFollower()
    command, _ = controller.step(feed.snapshot(0.0, cloud=PointCloud2(width=3, point_step=4)), controller.start())
    assert speeds(command) == (0.0, 0.0)
    assert command.status.startswith("standing: ")
