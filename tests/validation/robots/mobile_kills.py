"""kill -9 of the controller, of the safety monitor and of the bus while a base drives: it stands within 1.2 s.

    python tests/validation/robots/mobile_kills.py --bus zenoh-client --kills 200 -o out/kills.jsonl
    python tests/validation/robots/mobile_kills.py --bus dds --what controller --what monitor --kills 200
    python tests/validation/robots/mobile_kills.py --bus ros1 --kills 200 --ros1 out/ros1

A simulated TurtleBot 4, ``vlatool run safety-monitor``, ``vlatool run roi-follower`` (or ``--controller``) and the bus
are processes; the base obeys ``/safe_cmd_vel``. While it drives at 0.2 m/s or more, at a random moment, one of them is
killed, in random order. What counts is the time until the base stands, linear and angular, by its own truth, and that
it goes on standing for a second. A kill is repeated where the base stood in time by the clock of its simulation and too
late by the real one, because the simulation did not keep up. The bus is Zenoh's router, or the master of ROS 1; DDS has
neither. Where the nodes talk on without it (``zenoh``, whose nodes are peers, and ``ros1``), the base drives on under
control, which is counted; then the controller is killed, too, and the base has to stand. Robots run side by side
(``--robots``). Ends with 1 where a base did not stand in time, or moved again within a second.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import queue
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from _killed_nodes import BUSES, DRIVING, LEADS, PATIENCE_S, Robot, elapsed_s, last_rest
from _ros1 import prepare

LIMIT_S, STANDING_S = 1.2, 1.0
DRIVES_ON_S = 4.0
"""Time after a kill, by both clocks, at which a base that has not stood for a second since drives on."""
STANDSTILL_M = 0.002
"""Way within a second of standing that counts as none, in metres."""
MOST_LAG_S = 0.1
"""Time by which the clock of the simulation may differ from the real one from a kill to the standstill, in s."""
WHAT = ("controller", "monitor", "bus")
TALKS_ON = ("zenoh", "ros1")
"""Buses whose nodes talk to each other when the process that is the bus is dead."""


@dataclass
class Kill:
    """What one kill did: when, by both clocks, the last standstill began that lasted for a second.

    Args:
        what: What was killed.
        linear, angular: Speeds of the base at the kill, in m/s and rad/s.
        stood_s: Time until the base stood, in s; None where it did not.
        simulated_s: The same by the clock of its simulation, which falls behind where the processor is too slow.
        way_m: Way that it went until then, in m.
        gap_s: Largest time between two ticks of its simulation meanwhile, in s.
        drove_on: Whether it drove on without the bus; all else is then of the kill of the controller after that.
        lag_s: Largest difference between those two clocks, from the kill until the base stood, in s.
        problem: What was wrong; empty where nothing was.
    """

    what: str
    linear: float
    angular: float
    stood_s: float | None = None
    simulated_s: float | None = None
    way_m: float = 0.0
    gap_s: float = 0.0
    drove_on: bool = False
    lag_s: float = 0.0
    problem: str = ""

    @property
    def decides(self) -> bool:
        """Whether it says anything of a base, whose processor is its own.

        A simulation that has to wait for this processor is late; a standstill that came in time by its clock, and too
        late by the real one, then says nothing. Where both are in time, or its own clock says too late, it does.
        """
        late = (self.stood_s or 0.0) > LIMIT_S
        return not (late and self.lag_s > MOST_LAG_S and (self.simulated_s or 0.0) <= LIMIT_S)


def watch(robot: Robot, what: str) -> Kill:
    """Kill a process, and look until the base has stood for a second, or has not within ``DRIVES_ON_S``."""
    last = robot.since(time.monotonic())[-1]
    killed_s = robot.nodes[what].kill()
    kill = Kill(what, last.linear, last.angular)
    while True:
        time.sleep(0.02)
        states = robot.since(killed_s)
        rest = last_rest(states)
        over = elapsed_s(states) > DRIVES_ON_S
        if rest is not None and (rest.lasted_s >= STANDING_S or over):
            kill.stood_s, kill.simulated_s, kill.way_m = rest.began_s - killed_s, rest.simulated_s, rest.way_m
            kill.lag_s = abs(rest.began_s - states[0].when_s - rest.simulated_s)
            if rest.moved_m > STANDSTILL_M:
                kill.problem = f"moved by {rest.moved_m:.4f} m while its wheels stood"
            break
        if over:
            break
        if time.monotonic() - killed_s > PATIENCE_S:
            raise SystemExit(f"the simulation has not made {DRIVES_ON_S:g} s within {PATIENCE_S:g} s")
    kill.gap_s = max(after.when_s - before.when_s for before, after in itertools.pairwise(states))
    return kill


def judge(kill: Kill, robot: Robot) -> Kill:
    """Say what was wrong: with the base, or with a process that was not killed."""
    for_another_reason = kill.what == "bus" and robot.bus in TALKS_ON and not kill.drove_on
    if kill.stood_s is None:
        kill.problem = "drives on"
    elif max(kill.stood_s, kill.simulated_s or 0.0) > LIMIT_S and not for_another_reason:
        kill.problem = f"stands after {kill.stood_s:.2f} s"
    kill.problem += "".join(node.ended() for node in robot.nodes.values() if node.alive)
    return kill


def trial(robot: Robot, what: str, random: np.random.Generator) -> Kill:
    """Kill one process of a robot that drives, judge what the base does, and start the process again."""
    while robot.drive(float(random.uniform(0.0, 1.0))).linear < DRIVING:
        pass
    kill = watch(robot, what)
    if what == "bus" and robot.bus in TALKS_ON and kill.stood_s is None:
        kill = replace(watch(robot, "controller"), what="bus", drove_on=True)
    judge(kill, robot)
    for node in robot.nodes.values():
        if not node.alive:
            node.start()
    return kill


def spread(values: list[float]) -> str:
    """Return median, 99th percentile and maximum."""
    if not values:
        return "-"
    p50, p99 = np.percentile(values, 50), np.percentile(values, 99, method="higher")
    return f"p50 {p50:.3f}, p99 {p99:.3f}, max {max(values):.3f}"


def times(kills: list[Kill]) -> list[str]:
    """Return lines on when and where bases stood."""
    prompt = [kill.stood_s or 0.0 for kill in kills if kill.lag_s <= MOST_LAG_S]
    return [
        f"  s until it stands, {len(prompt)} whose simulation kept to {MOST_LAG_S:g} s: {spread(prompt)}",
        f"  s until it stands, all: {spread([kill.stood_s or 0.0 for kill in kills])}",
        f"  s by the clock of the simulation, all: {spread([kill.simulated_s or 0.0 for kill in kills])}",
        f"  m until it stands: {spread([kill.way_m for kill in kills])}",
        f"  m/s at the kill: {spread([kill.linear for kill in kills])}, min {min(kill.linear for kill in kills):.3f}",
    ]


def table(bus: str, kills: list[Kill]) -> list[str]:
    """Return what was seen, a few lines for each thing that was killed."""
    lines = []
    for what in dict.fromkeys(kill.what for kill in kills):
        those = [kill for kill in kills if kill.what == what and kill.decides]
        late = [kill.simulated_s or 0.0 for kill in kills if kill.what == what and not kill.decides]
        on = [kill for kill in those if kill.drove_on]
        stood = [kill for kill in on or those if kill.stood_s is not None]
        how = f"base drives on after {len(on)}; once the controller is killed, too, it" if on else "base"
        lines.append(f"{bus}, kill -9 of the {what}: {len(those)}, the {how} stands after {len(stood)}")
        lines += times(stood) if stood else []
        lines += [f"  FAIL {kill.problem}: {kill}" for kill in those if kill.problem]
        if late:
            lines.append(f"  repeated {len(late)} whose simulation did not keep up; s by its clock: {spread(late)}")
    return lines


def run_robot(number: int, options: argparse.Namespace, waiting: queue.Queue[str], kills: list[Kill]) -> None:
    """Take kills from a queue until it is empty; append what each did."""
    random = np.random.default_rng([options.seed, number])
    folder = Path(options.folder) / f"robot{number}"
    with Robot(options.bus, options.controller, folder, number, options.ros1.resolve()) as robot:
        while True:
            try:
                what = waiting.get_nowait()
            except queue.Empty:
                break
            kill = trial(robot, what, random)
            kills.append(kill)
            if not kill.decides:
                waiting.put(what)
            if options.output is not None:
                with options.output.open("a") as file:
                    file.write(
                        json.dumps({"bus": options.bus, "controller": options.controller, **asdict(kill)}) + "\n"
                    )
    if robot.refused:
        last = robot.refused[-1]
        print(f"robot {number}: {len(robot.refused)} starts were refused and made again, the last: {last}", flush=True)


def run(options: argparse.Namespace) -> list[Kill]:
    """Make all kills, in random order, with several robots side by side."""
    whats = [what for what in options.what for _ in range(options.kills)]
    waiting: queue.Queue[str] = queue.Queue()
    for what in np.random.default_rng(options.seed).permutation(whats):
        waiting.put(str(what))
    kills: list[Kill] = []
    if options.bus == "ros1":  # once, before the robots, which would unpack it over each other
        prepare(options.ros1.resolve())
    with ThreadPoolExecutor(options.robots) as pool:
        robots = [pool.submit(run_robot, number, options, waiting, kills) for number in range(options.robots)]
        try:
            for robot in robots:
                robot.result()
        except BaseException:
            with contextlib.suppress(queue.Empty):  # let the others end after the kill that they make
                while True:
                    waiting.get_nowait()
            raise
    return kills


def show(files: list[Path]) -> int:
    """Print what was seen in earlier runs, from their files; return 1 where something was wrong."""
    rows = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    names = [field.name for field in fields(Kill)]
    kills = {bus: [Kill(**{name: row[name] for name in names}) for row in rows if row["bus"] == bus] for bus in BUSES}
    for bus in filter(kills.get, BUSES):
        print(*table(bus, kills[bus]), sep="\n")
    return int(any(kill.problem for those in kills.values() for kill in those if kill.decides))


def main() -> int:
    """Run, and print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bus", choices=BUSES, default="zenoh-client")
    parser.add_argument("--what", choices=WHAT, action="append", help="what is killed; all when not given")
    parser.add_argument("--kills", type=int, default=200, help="of each")
    parser.add_argument("--robots", type=int, default=2, help="side by side")
    parser.add_argument("--controller", choices=LEADS, default="roi-follower")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ros1", type=Path, default=Path("out/ros1"), help="folder for ROS 1")
    parser.add_argument("-o", "--output", type=Path, help="file to which a line of JSON is added for each kill")
    parser.add_argument("--table", type=Path, action="append", help="such a file, whose kills are shown; none is made")
    options = parser.parse_args()
    if options.table:
        return show(options.table)
    options.what = options.what or [what for what in WHAT if what != "bus" or options.bus != "dds"]
    if options.bus == "dds" and "bus" in options.what:
        parser.error("DDS has no process that is the bus")
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        options.folder = folder
        kills = run(options)
    print(*table(options.bus, kills), sep="\n")
    print(f"{len(kills)} kills of {options.robots} robots in {time.monotonic() - began:.0f} s")
    counted = [kill for kill in kills if kill.decides]
    return int(len(counted) < options.kills * len(options.what) or any(kill.problem for kill in counted))


if __name__ == "__main__":
    sys.exit(main())
