"""No message of any content ends a controller of a base, or makes it command what is no number or too fast."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from _full import small_or_full

from vlatool.controllers import Reading, Request, Snapshot
from vlatool.messages._members import members
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.sensor_msgs import PointCloud2, PointField
from vlatool.registry import load

NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1e308, 5e-324, 1.0, -1.0, 0.5, 3.0)
TEXTS = ("", "x", "rgb8", "bgr8", "mono8", "16UC1", "32FC1", "64FC1", "bayer_rggb8", "yuyv", "running", "arrived",
         "x" * 3000, "\x1b[31m", "\0", "\u202e")  # fmt: skip
COUNTS = (0, 1, 2, 3, 4, 8, 12, 16, 127)


class Hostile:
    """Messages of any type with any content that their fields take."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def pick(self, values: Any) -> Any:
        return values[int(self.random.integers(len(values)))]

    def value(self, primitive: str) -> Any:
        if primitive == "bool":
            return bool(self.random.random() < 0.5)
        if primitive == "string":
            return self.pick(TEXTS)
        if primitive.startswith("float"):
            return float(self.pick(NUMBERS) if self.random.random() < 0.6 else self.random.uniform(-4, 4))
        bounds = np.iinfo("uint8" if primitive == "byte" else primitive)
        return int(self.pick((bounds.min, bounds.max)) if self.random.random() < 0.1 else self.pick(COUNTS))

    def message(self, kind: type) -> Any:
        if kind is PointField and self.random.random() < 0.9:
            return PointField(
                self.pick("xyz"), self.pick((0, 4, 8, 2**32 - 1)), self.pick((7, 7, 8, 1, 0)), self.pick((0, 1, 2))
            )
        found = {member.attribute: self._field(member) for member in members(kind)}
        if kind is PointCloud2:
            count, step = self.pick((1, 2, 5)), self.pick((12, 16, 32))
            data = self.random.normal(size=count * step // 4).astype(np.float32).view(np.uint8)
            fields = tuple(PointField(name, 4 * place, 7, self.pick((1, 1, 0, 2))) for place, name in enumerate("xyz"))
            found |= {"height": 1, "width": count, "point_step": step, "row_step": count * step, "data": data}
            found |= {"fields": fields} if self.random.random() < 0.8 else {}
        return kind(**found)

    def _field(self, member: Any) -> Any:
        if member.message is not None:
            each = [self.message(member.message) for _ in range(self.pick((0, 1, 3)) if member.sequence else 1)]
            return tuple(each) if member.sequence else each[0]
        if not (member.sequence or member.length):
            return self.value(member.primitive)
        values = [self.value(member.primitive) for _ in range(member.length or self.pick((0, 1, 7, 48, 192)))]
        if member.primitive == "string":
            return tuple(values)
        with np.errstate(over="ignore"):
            return (
                np.array(values, np.float64).astype(member.primitive)
                if "float" in member.primitive
                else np.array(values, member.primitive)
            )


@pytest.mark.parametrize("name", ["safety-monitor", "cloud-follower", "roi-follower", "roi-tracker"])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_no_message_ends_a_controller_or_makes_it_command_no_number(name: str) -> None:
    hostile, controller = Hostile(3), load("controllers", name)()
    state, newest, time_s = controller.start(), {}, 0.0
    for step in range(small_or_full(400, 20_000)):
        time_s += hostile.pick((0.02, 0.1, 0.3, 2.0))
        readings = {entry.name: (Reading(hostile.message(entry.message), time_s, step),)
                    for entry in controller.inputs if hostile.random.random() < 0.6}  # fmt: skip
        newest |= {entry: each[-1] for entry, each in readings.items()}
        requests = tuple(
            Request(service.name, hostile.message(service.request), step) for service in controller.services
        )
        stamp = hostile.message(Time) if hostile.random.random() < 0.1 else Time.from_seconds(1000 + time_s)
        command, state = controller.step(Snapshot(time_s, stamp, readings, dict(newest), requests), state)
        assert len(command.status) < 1000
        for message in (each for sent in command.messages.values() for each in sent if isinstance(each, Twist)):
            assert abs(message.linear.x) <= 0.5
            assert abs(message.angular.z) <= 3.0
