"""A node that answers on a bus, in a process of its own: each Image with a Twist, each Twist with itself.

python tests/validation/robots/answering_node.py zenoh:tcp/127.0.0.1:7447
"""

from __future__ import annotations

import sys

from _bus_trials import QUALITY

from vlatool.buses import open_bus
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.sensor_msgs import Image


def main() -> None:
    bus = open_bus(sys.argv[1], "answering_node")
    send = bus.publisher("/from_node", Twist, QUALITY)
    bus.subscribe("/to_node", Twist, lambda reception: send(reception.message), QUALITY)
    bus.subscribe("/image_to_node", Image, lambda reception: send(_measure(reception.message)), QUALITY)
    print("ready", flush=True)
    sys.stdin.read()
    bus.close()


def _measure(image: Image) -> Twist:
    return Twist(linear=Vector3(x=float(image.data.nbytes), y=float(image.data[-1])))


if __name__ == "__main__":
    main()
