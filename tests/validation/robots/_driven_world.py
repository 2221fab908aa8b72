"""A simulated TurtleBot 4 on a bus, in a process of its own, with a target that is always ahead of it.

    python tests/validation/robots/_driven_world.py BUS DISTANCE BEARING SEED SENSORS

Each tick of its simulation is a line on stdout: the time (``time.monotonic``), the simulated time, both in s, then v in
m/s, w in rad/s, x and y in m, all of its own truth. A line ``release`` on stdin has it ask the safety monitor to leave
EMERGENCY, as an operator does; it ends with stdin.
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time

import numpy as np

from vlatool.buses import Bus, open_bus
from vlatool.errors import BusError
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse
from vlatool.nodes.world_node import WorldNode
from vlatool.worlds import World, open_world

SIZE_M = 10.0
HOME_M = 2.0
"""Distance from the middle of the room beyond which the target leads back to it, in metres."""
DRAWN_EACH_TICKS = 150


class Target:
    """The red target, at a constant distance from the robot and at a random bearing that changes now and then.

    Args:
        distance_m: Distance from the middle of the robot.
        bearing_rad: Largest bearing to each side.
    """

    def __init__(self, distance_m: float, bearing_rad: float, seed: int) -> None:
        self.distance_m, self.most = distance_m, bearing_rad
        self._random = np.random.default_rng([seed, 41])
        self._bearing, self._ticks = 0.0, 0

    def lead(self, world: World) -> None:
        """Place it for the next tick, and tell the truth about this one."""
        truth = world.truth()
        (x, y, yaw), (linear, angular) = truth["pose"], truth["velocity"]
        if self._ticks % DRAWN_EACH_TICKS == 0:
            self._bearing = float(self._random.uniform(-self.most, self.most))
        self._ticks += 1
        bearing = self._bearing
        if math.hypot(x, y) > HOME_M:
            homeward = math.remainder(math.atan2(-y, -x) - yaw, 2.0 * math.pi)
            bearing = max(-self.most, min(self.most, homeward))
        world.place_target(x + self.distance_m * math.cos(yaw + bearing), y + self.distance_m * math.sin(yaw + bearing))
        sys.stdout.write(f"{time.monotonic():.6f} {world.time_s:.2f} {linear:.5f} {angular:.5f} {x:.6f} {y:.6f}\n")
        sys.stdout.flush()


def obey_operator(bus: Bus, node: WorldNode) -> None:
    """Release emergencies when told on stdin, until that ends."""
    for line in sys.stdin:
        if line.strip() == "release":
            with contextlib.suppress(BusError):  # the monitor, or the bus, may be dead
                bus.call("/safety_monitor/emergency", SetBoolRequest(False), SetBoolResponse, 2.0)
    node.stop()


def main() -> None:
    address, distance_m, bearing_rad, seed = sys.argv[1], *map(float, sys.argv[2:4]), int(sys.argv[4])
    world = open_world(
        "turtlebot4", size_m=SIZE_M, pillars=0, target_m=distance_m, command_topic="/safe_cmd_vel", width=80, height=60,
        only=f"{sys.argv[5]},depth,scan,odom,joints,battery",
    )  # fmt: skip
    bus = open_bus(address, "vlatool_turtlebot4")
    node = WorldNode(world, bus, seed)
    threading.Thread(target=obey_operator, args=(bus, node), daemon=True).start()
    node.run(observer=Target(distance_m, bearing_rad, seed).lead)
    bus.close()


if __name__ == "__main__":
    main()
