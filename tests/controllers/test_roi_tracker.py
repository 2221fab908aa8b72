from __future__ import annotations

import numpy as np
import pytest
from _full import small_or_full
from _mobile_feed import Feed, camera_info, speeds
from _tutorial_laws import turn

from vlatool.controllers.roi_tracker import RoiTracker
from vlatool.errors import UsageError
from vlatool.messages.pixels import image_message
from vlatool.messages.sensor_msgs import Image, RegionOfInterest

MESSAGES = small_or_full(1_000, 100_000)


def region(x: int, y: int, width: int, height: int) -> RegionOfInterest:
    return RegionOfInterest(x_offset=x, y_offset=y, width=width, height=height)


def random_region(random: np.random.Generator, width: int, height: int) -> RegionOfInterest:
    x, y = int(random.integers(width - 1)), int(random.integers(height - 1))
    return region(x, y, int(random.integers(1, width - x + 1)), int(random.integers(1, height - y + 1)))


def test_the_law_is_that_of_the_tutorial():
    random, feed = np.random.default_rng(1), Feed()
    for count in range(MESSAGES):
        if count % 100 == 0:
            gain, threshold, low = random.uniform(0.1, 5), random.uniform(0, 0.5), random.uniform(0, 1)
            high = low + random.uniform(0, 2)
            controller = RoiTracker(gain=gain, x_threshold=threshold, min_rotation_speed=low, max_rotation_speed=high)
            width, height = int(random.integers(3, 800)), int(random.integers(3, 600))
            state = controller.start()
        roi = random_region(random, width, height)
        snapshot = feed.snapshot(count * 0.1, camera_info=camera_info(width, height), roi=roi)
        command, state = controller.step(snapshot, state)
        expected = turn(roi.x_offset, roi.width, width, gain, threshold, low, high)
        assert speeds(command) == pytest.approx((0.0, expected), abs=1e-9)


def test_it_turns_at_gain_2_beyond_a_tenth_of_the_half_image_between_half_and_two_radians_a_second():
    controller = RoiTracker()
    assert [controller.rotation(offset) for offset in (0.1, -0.1, 0.101, -0.101, 0.6, -0.6, 1.5)] == pytest.approx(
        [0.0, 0.0, -0.5, 0.5, -1.2, 1.2, -2.0]
    )


def test_it_stands_without_a_new_region_and_with_one_without_size():
    feed, controller = Feed(), RoiTracker()
    state = controller.start()
    command, state = controller.step(feed.snapshot(0.0, camera_info=camera_info(), roi=region(50, 0, 10, 10)), state)
    assert speeds(command)[1] < 0
    command, state = controller.step(feed.snapshot(0.1), state)
    assert speeds(command) == (0.0, 0.0)
    assert command.status == "standing: no new region"
    command, state = controller.step(feed.snapshot(0.2, roi=region(50, 0, 0, 10)), state)
    assert speeds(command) == (0.0, 0.0)


def test_a_region_outside_of_the_image_is_refused_by_its_numbers():
    feed, controller = Feed(), RoiTracker()
    snapshot = feed.snapshot(0.0, camera_info=camera_info(64, 48), roi=region(60, 0, 10, 10))
    command, _ = controller.step(snapshot, controller.start())
    assert speeds(command) == (0.0, 0.0)
    assert command.status == "standing: region 10 x 10 at 60, 0 outside of the image of 64 x 48"


@pytest.mark.parametrize("first", ["setting", "topic"])
def test_a_correlation_filter_follows_a_first_region(first: str):
    random, feed = np.random.default_rng(4), Feed()
    background, patch = random.integers(0, 80, (48, 64, 3)), random.integers(120, 256, (12, 12, 3))
    controller = RoiTracker(roi="26,18,12,12") if first == "setting" else RoiTracker(track=True)
    state, offsets = controller.start(), []
    for step in range(15):
        pixels = background.copy()
        pixels[18:30, 26 + step : 38 + step] = patch
        messages = {"roi": region(26, 18, 12, 12)} if first == "topic" and step == 0 else {}
        image = image_message(pixels.astype(np.uint8), "rgb8")
        snapshot = feed.snapshot(step * 0.1, camera_info=camera_info(64, 48), image=image, **messages)
        command, state = controller.step(snapshot, state)
        assert command.status == "tracking"
        offsets.append(command.notes["offset"])
    assert offsets == pytest.approx([step / 32 for step in range(15)], abs=2 / 32)
    assert speeds(command)[1] == pytest.approx(-2 * offsets[-1])
    command, _ = controller.step(feed.snapshot(1.5, image=image_message(background.astype(np.uint8), "rgb8")), state)
    assert command.status == "standing: target lost"
    assert speeds(command) == (0.0, 0.0)


def test_an_image_of_an_unknown_encoding_is_a_status():
    feed, controller = Feed(), RoiTracker(roi="1,1,5,5")
    image = Image(height=1, width=1, encoding="palette8", step=1, data=np.zeros(1, np.uint8))
    command, _ = controller.step(feed.snapshot(0.0, camera_info=camera_info(), image=image), controller.start())
    assert speeds(command) == (0.0, 0.0)
    assert "palette8" in command.status


@pytest.mark.parametrize(
    "settings",
    [
        {"rate": 0.0}, {"min_rotation_speed": 3.0}, {"roi": "1,2,3"}, {"roi": "1,2,0,4"}, {"roi": "left"},
        {"max_rotation_speed": float("nan")},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings: dict[str, object]):
    with pytest.raises(UsageError) as caught:
        RoiTracker(**settings)
    assert caught.value.fix
    assert "allowed" in caught.value.message
