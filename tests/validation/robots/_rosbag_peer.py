"""ROS 1's own rosbag and generated messages: what our bags meet. Nothing of vlatool is imported.

python _rosbag_peer.py read BAG | write BAG
"""

from __future__ import annotations

import json
import sys
from io import BytesIO

import genpy
import numpy as np
import rosbag
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image, JointState, LaserScan


def read(path: str) -> None:
    """Print topic, type, time and bytes of each message, as the generated classes write them again."""
    with rosbag.Bag(path) as bag:
        for topic, message, time in bag.read_messages():
            buffer = BytesIO()
            message.serialize(buffer)
            print(json.dumps([topic, message._type, time.to_nsec(), buffer.getvalue().hex()]))


def write(path: str) -> None:
    """Write a bag of random messages, some of it compressed, and print what is in it as ``read`` does."""
    draw = np.random.default_rng(5)
    with rosbag.Bag(path, "w", compression="bz2") as bag:
        for index in range(200):
            bag.write(*message(draw, index), t=genpy.Time(1_700_000_000 + index // 10, index % 10 * 100_000_000))
    read(path)


def message(draw: np.random.Generator, index: int) -> tuple[str, object]:
    """Return a topic and a random message of it."""
    kind = index % 5
    if kind == 0:
        data = draw.integers(0, 256, 60 * 80 * 3, np.uint8).tobytes()
        return "/image", Image(height=60, width=80, encoding="rgb8", step=240, data=data)
    if kind == 1:
        return "/joint_states", JointState(name=["a", "ü"], position=draw.normal(size=2).tolist())
    if kind == 2:
        return "/scan", LaserScan(angle_max=3.14, ranges=draw.normal(size=360).tolist())
    if kind == 3:
        odometry = Odometry(child_frame_id="base")
        odometry.pose.covariance = draw.normal(size=36).tolist()
        odometry.header.frame_id = "odom"
        return "/odom", odometry
    twist = Twist()
    twist.linear.x, twist.angular.z = draw.normal(size=2).tolist()
    return "/cmd_vel", twist


if __name__ == "__main__":
    globals()[sys.argv[1]](sys.argv[2])
