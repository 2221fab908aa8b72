"""Live runs over ROS 1, recorded by ROS 1's own ``rosbag record`` and by ``vlatool record``, and replayed bit for bit.

    python tests/validation/robots/ros1_live.py -o out/ros1 --bundle BUNDLE

A simulated robot, a controller and the recorders are processes of their own beside a real master. BUNDLE is the int8
bundle of ``sample_models/vln-babyai``; without one, the controller ``vln`` is left out. Unpacks ROS 1 into the folder
as ``ros1_bus.py`` does, prints a table, and exits with 1 when a line of it failed.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _ros1 import Rows, prepare
from _ros1_processes import Programs, read_json
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from vlatool.buses.bag import Bag
from vlatool.messages.ros1 import encode
from vlatool.nodes.run_log import Received, read_log

TARGET = ("--target-m", 1.5, "--target-speed", 0.3, "--pillars", 2)


@dataclass(frozen=True)
class Case:
    """A controller and the robot that it drives.

    Args:
        robot: Words behind ``vlatool sim``.
        topics: Topics that the controller reads and writes.
        command: That of its commands.
        driver: Words of another controller, whose commands it reads.
    """

    robot: tuple[object, ...]
    topics: tuple[str, ...]
    command: str = "/cmd_vel"
    driver: tuple[object, ...] = ()


CASES = {
    "roi-follower": Case(
        ("turtlebot4", *TARGET, "--only", "info,roi,depth,odom"),
        ("/camera/color/camera_info", "/roi", "/camera/depth/image_raw"),
    ),
    "cloud-follower": Case(
        ("turtlebot4", "--target-m", 0.9, "--pillars", 2, "--only", "cloud,odom"), ("/camera/depth/points",)
    ),
    "safety-monitor": Case(
        ("turtlebot4", *TARGET, "--only", "info,roi,depth,odom,scan,battery,joints,person", "--command-topic",
         "/safe_cmd_vel"),
        ("/cmd_vel", "/scan", "/camera/depth/image_raw", "/odom", "/battery_state", "/joint_states",
         "/person_in_workspace", "/safety_monitor/level"),
        "/safe_cmd_vel", ("roi-follower", "--rate", 10),
    ),
    "vln": Case(("babyai",), ("/camera/color/image_raw", "/camera/depth/image_raw", "/odom", "/vln/instruction",
                              "/vln/arrived", "/vln/status")),
}  # fmt: skip


class Live:
    """One run of a controller with its recorders.

    Args:
        programs: Where processes are started.
        bags: Folder for the bags.
        name: Controller.
        bundle: Words that name its policy.
    """

    def __init__(self, programs: Programs, bags: Path, name: str, bundle: tuple[object, ...]) -> None:
        self.programs, self.bags, self.name, self.bundle = programs, bags, name, bundle
        self.case, self.node = CASES[name], f"/vlatool_{name.replace('-', '_')}"

    def record(self, recorders: Sequence[str], seconds: float, interrupted: bool) -> dict[str, Any]:
        """Record a run of some seconds; return its result."""
        bus = ("--bus", f"ros1:{self.programs.master.uri}")
        robot = self.programs.vlatool("sim", *self.case.robot, *bus)
        robot.wait_for("reports")
        driver = [self.programs.vlatool("run", *self.case.driver, *bus)] if self.case.driver else []
        for each in driver:
            each.wait_for("runs:")
        running = [self._recorder(kind) for kind in recorders]
        killed = [self._recorder("killed")] if interrupted else []
        time.sleep(2.5)  # each recorder has subscribed to what there is
        run = self.programs.vlatool("run", self.name, *self.bundle, *bus, "--seconds", seconds, "--json")
        if interrupted:
            run.wait_for("runs:")
            time.sleep(1.5)
            running.append(self._recorder("late"))
            time.sleep(max(0.0, seconds - 2.5))
            killed[0].end(signal.SIGKILL)
        code, text = run.answer(seconds + 60)
        if code:
            raise SystemExit(f"vlatool run {self.name} ended with {code}:\n{run.errors()}")
        time.sleep(0.5)
        for each in (*running, *driver, robot):
            each.end()
        return read_json(text)

    def _recorder(self, kind: str) -> Any:
        if kind in ("ours", "mcap"):
            path = self.bags / ("ours.bag" if kind == "ours" else "ours.mcap")
            return self.programs.vlatool("record", "--bus", f"ros1:{self.programs.master.uri}", "-o", path)
        own = (f"{self.node}/steps", f"{self.node}/controller", self.case.command, *self.case.topics)
        topics = ("--lz4", *own) if kind == "topics" else ("-a",)
        return self.programs.ros("rosbag", "record", "-O", self.bags / f"{kind}.bag", *topics)

    def replay(self, bag: Path) -> tuple[int, dict[str, Any], str]:
        """Return the exit code, the result and the words of ``vlatool replay``."""
        program = self.programs.vlatool("replay", bag, self.name, *self.bundle[:2], "--json")
        code, text = program.answer(120)
        return code, read_json(text), program.errors()

    def commands(self, bag: Path) -> list[str]:
        """Return the commands in a bag, as bytes of ROS 1 that are written again."""
        opened = Bag(str(bag), "reader")
        document = [encode(one.message).hex() for one in opened.messages([self.case.command])]
        opened.close()
        return document

    def commands_of_rosbags(self, bag: Path) -> list[str]:
        """Return the same by rosbags and its own definitions."""
        store = get_typestore(Stores.ROS1_NOETIC)
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            chosen = [each for each in reader.connections if each.topic == self.case.command]
            return [bytes(store.serialize_ros1(reader.deserialize(data, each.msgtype), each.msgtype)).hex()
                    for each, _, data in reader.messages(chosen)]  # fmt: skip


PATHS = {"topics": "topics.bag", "all": "all.bag", "ours": "ours.bag", "mcap": "ours"}
"""Recorder -> its bag."""
WHO = {
    "topics": "rosbag record --lz4 TOPICS", "all": "rosbag record -a", "ours": "vlatool record -o x.bag",
    "mcap": "vlatool record -o x.mcap",
}  # fmt: skip


def try_live(
    programs: Programs,
    name: str,
    bundle: tuple[object, ...],
    seconds: float,
    rows: Rows,
    recorders: Sequence[str] = tuple(PATHS),
) -> None:
    """Record a run by several recorders at once; replay each bag, and compare the commands in them."""
    with tempfile.TemporaryDirectory() as folder:
        run = Live(programs, Path(folder), name, bundle)
        result = run.record(recorders, seconds, interrupted=name == "roi-follower")
        commands = {}
        for kind in recorders:
            path = PATHS[kind]
            code, document, said = run.replay(run.bags / path)
            counts = f"{document.get('steps')} of {result['steps']} steps, {document.get('messages')} messages"
            words = f"{counts}, {document.get('unheard')} unheard {document.get('note', '')}"
            right = not code and document["equal"] and document["steps"] == result["steps"] and not document["unheard"]
            rows.append((f"{name}: {WHO[kind]}, replayed bit-equal", words if document else last_line(said), right))
            commands[kind] = run.commands(run.bags / path)
            by_rosbags = run.commands_of_rosbags(run.bags / path) if kind in ("ours", "mcap") else commands[kind]
            if by_rosbags != commands[kind]:
                rows.append((f"{name}: {path} as rosbags reads it", f"{len(by_rosbags)} commands differ", False))
        moving = len(set(commands["ours"]))
        same = all(each == commands["ours"] for each in commands.values())
        said = f"{len(commands['ours'])} commands, {moving} different ones"
        rows.append((f"{name}: commands in these bags are bit-equal", said, same and moving > 3))
        info(programs, run.bags / "ours.bag", rows)
        if name == "roi-follower":
            try_interruptions(run, rows)
            try_playing(run, rows)


def info(programs: Programs, bag: Path, rows: Rows) -> None:
    """Let ``rosbag info`` read a bag of ours."""
    code, text = programs.ros("rosbag", "info", bag).answer()
    count = next((line.split()[1] for line in text.splitlines() if line.startswith("messages:")), "0")
    rows.append(
        ("rosbag info of vlatool record's bag", f"exit code {code}, {count} messages", not code and count > "0")
    )


def try_playing(run: Live, rows: Rows) -> None:
    """Let ``rosbag play``, a node of roscpp, publish a bag for a controller, and replay its log."""
    bus, log = ("--bus", f"ros1:{run.programs.master.uri}"), run.bags / "played.log"
    started = run.programs.vlatool("run", run.name, *run.bundle, *bus, "--seconds", 5, "--record", log)
    started.wait_for("runs:")
    player = run.programs.ros("rosbag", "play", run.bags / "all.bag", "--topics", *run.case.topics)
    code, _ = started.answer()
    player.end()
    again, document, said = run.replay(log)
    heard = sum(isinstance(item, Received) for item in read_log(log))
    words = f"{heard} messages heard, {document.get('steps')} steps"
    right = code == again == 0 and heard > document["steps"]
    rows.append((f"{run.name}: rosbag play, a node of roscpp", words if document else last_line(said), right))


def try_interruptions(run: Live, rows: Rows) -> None:
    """Replay a bag that begins late, and one whose recorder was killed, before and after ``rosbag reindex``."""
    left = run.bags / "killed.bag.active"
    for what, path, words in (
        ("begun in the middle of a run", run.bags / "late.bag", "The recording begins at step"),
        ("of a killed recorder", left, "rosbag reindex"),
    ):
        code, _, said = run.replay(path)
        rows.append((f"a bag {what}: refused with", last_line(said), code == 3 and words in said))
    code, _ = run.programs.ros("rosbag", "reindex", left).answer()
    if left.exists():
        left.rename(run.bags / "killed.bag")
    again, document, said = run.replay(run.bags / "killed.bag")
    words = f"{document.get('steps')} steps; {document.get('note')}" if document else last_line(said)
    rows.append(("the same after rosbag reindex and mv: replayed bit-equal", words, code == again == 0))


def last_line(text: str) -> str:
    """Return the sentence of an error."""
    lines = [line for line in text.strip().splitlines() if "error" in line.lower() or "fix:" in line]
    return " ".join(" ".join(lines[-2:]).split())[:300] or text.strip()[-200:]


def main() -> None:
    """Prepare the folder, run each controller, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ros1"), help="folder for ROS 1")
    parser.add_argument("--bundle", type=Path, help="int8 bundle of sample_models/vln-babyai")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="controllers")
    parser.add_argument("--seconds", type=float, default=6.0, help="length of each run")
    given = parser.parse_args()
    folder = given.output.resolve()
    environment, rows = prepare(folder), []
    for name in given.only:
        if name == "vln" and given.bundle is None:
            continue
        bundle = ("--bundle", given.bundle.resolve(), "--threads", 1) if name == "vln" else ()
        with Programs(folder, environment, folder / "printed" / name) as programs:
            try_live(programs, name, bundle, given.seconds, rows)
    for what, said, right in rows:
        print(f"{'ok  ' if right else 'FAIL'} {what:72} {said}")
    sys.exit(int(not all(right for _, _, right in rows)))


if __name__ == "__main__":
    main()
