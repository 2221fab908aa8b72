"""The bus ``bag`` against ROS 1's own ``rosbag``: ours read by it, its read by ours, and ``rosbag info``.

    python tests/validation/robots/ros1_bags.py -o out/ros1

Unpacks ROS 1 into the folder as ``ros1_bus.py`` does, prints a table, and exits with 1 when a line of it failed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from _ros1 import prepare

from vlatool.buses import QoS
from vlatool.buses.bag import Bag
from vlatool.messages.ros1 import encode, type_name

HERE = Path(__file__).resolve().parent


def peer(environment: dict[str, str], *arguments: object) -> list[list[Any]]:
    """Return what ``_rosbag_peer.py`` prints."""
    command = [sys.executable, str(HERE / "_rosbag_peer.py"), *map(str, arguments)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def recorded(path: Path) -> list[list[Any]]:
    """Return topic, type, time and bytes of each message of a bag, as we read it and write it again."""
    bag = Bag(str(path), "reader")
    found = [
        [one.topic, type_name(type(one.message)), one.time_ns, encode(one.message).hex()] for one in bag.messages()
    ]
    bag.close()
    return found


def replayed(source: Path, new: Path) -> None:
    """Play a bag and publish each of its messages, so that they are written at the recorded times."""
    bag = Bag(f"{source}:{new}", "copier")
    kinds = {one.topic: type(one.message) for one in bag.messages()}
    for topic, kind in kinds.items():
        send = bag.publisher(f"/copy{topic}", kind, QoS())
        bag.subscribe(topic, kind, lambda got, send=send: send(got.message), QoS())
    bag.play()
    bag.close()


def main() -> None:
    """Write, read, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ros1"), help="folder for ROS 1")
    given = parser.parse_args()
    environment = prepare(given.output.resolve())
    rows: list[tuple[str, str, bool]] = []
    with tempfile.TemporaryDirectory() as folder:
        theirs, ours = Path(folder) / "theirs.bag", Path(folder) / "ours.bag"
        written = peer(environment, "write", theirs)
        found = recorded(theirs)
        equal = sum(one == other for one, other in zip(found, written, strict=False))
        rows.append((f"messages of rosbag's bag, bit-equal in ours, of {len(written)}", str(equal), found == written))
        replayed(theirs, ours)
        copied = [[f"/copy{topic}", *rest] for topic, *rest in written]
        again = peer(environment, "read", ours)
        equal = sum(one == other for one, other in zip(again, copied, strict=False))
        rows.append((f"messages of our bag, bit-equal in rosbag, of {len(copied)}", str(equal), again == copied))
        script = given.output.resolve() / "root/usr/bin/rosbag"
        command = [sys.executable, str(script), "info", str(ours)]
        info = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)
        told = f"messages:    {len(copied)}" in info.stdout and "geometry_msgs/Twist" in info.stdout
        rows.append(("rosbag info of our bag", f"exit code {info.returncode}", told and info.returncode == 0))
    for what, said, right in rows:
        print(f"{'ok  ' if right else 'FAIL'} {what:62} {said}")
    if not all(right for _, _, right in rows):
        print(info.stdout, info.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
