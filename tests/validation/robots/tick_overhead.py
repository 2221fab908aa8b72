"""Time around a controller's step on a bus: inboxes, snapshot, checks, sending; without a policy.

    python tests/validation/robots/tick_overhead.py [BUS] [--steps N]

One 230 kB image and one odometry message come before each step of 100 Hz; the controller sends a Twist and a String.
Exits with 1 when the 99th percentile is above 1 ms.
"""

from __future__ import annotations

import argparse
import sys
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlatool.buses import QoS, open_bus
from vlatool.controllers import Command, Input, Output
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import Header, String
from vlatool.nodes.run_log import Background, StepPublisher
from vlatool.nodes.runner import Runner
from vlatool.nodes.session import spread
from vlatool.nodes.step_record import ControllerRecord

LIMIT_MS = 1.0


@dataclass(frozen=True)
class Turns:
    """Turns with the odometry, whatever the camera shows."""

    rate_hz: float = 100.0
    inputs = (Input("image", "/image", Image), Input("odometry", "/odom", Odometry))
    outputs = (Output("cmd_vel", "/cmd_vel", Twist), Output("status", "/status", String))
    services = ()

    def start(self) -> int:
        return 0

    def step(self, snapshot: Any, state: int) -> Any:
        odometry = snapshot.message("odometry", Odometry)
        turn = 0.0 if odometry is None else odometry.twist.twist.angular.z
        messages = {"cmd_vel": (Twist(angular=Vector3(z=turn)),), "status": (String("turning"),)}
        return Command(messages, status="turning"), state + 1

    def rest(self) -> Any:
        return Command({"cmd_vel": (Twist(),)})


def main() -> None:
    """Measure, print, and exit with the verdict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bus", nargs="?", default="sim:overhead")
    parser.add_argument("--steps", type=int, default=3000)
    options = parser.parse_args()
    robot, own = open_bus(options.bus, "robot"), open_bus(options.bus.replace("router/", ""), "vlatool_turns")
    stop = threading.Event()
    send_image, send_odometry = (robot.publisher(topic, kind, QoS()) for topic, kind in
                                 (("/image", Image), ("/odom", Odometry)))  # fmt: skip
    image = Image(Header(), 240, 320, "rgb8", 0, 960, np.zeros(240 * 960, np.uint8))

    def publish() -> None:
        while not stop.wait(0.01):
            send_image(image)
            send_odometry(Odometry())

    thread = threading.Thread(target=publish)
    thread.start()
    background = Background(StepPublisher(own, ControllerRecord("turns", node="vlatool_turns")))
    summary = Runner(Turns(), own, observers=[background]).run(options.steps / 100)
    stop.set()
    thread.join()
    background.close()
    for bus in (own, robot):
        bus.close()
    found = spread(summary.overhead_ms)
    print(f"{options.bus}: {summary.steps} steps, {summary.skipped} left out; around a step p50 {found['p50']:.3f} ms, "
          f"p99 {found['p99']:.3f} ms; late p99 {spread(summary.late_ms)['p99']:.2f} ms")  # fmt: skip
    sys.exit(found["p99"] > LIMIT_MS)


if __name__ == "__main__":
    main()
