"""The sample policy vln-babyai over buses, world and controller in processes of their own, beside one process.

    python tests/validation/robots/vln_over_buses.py --episodes 100 --bundle BUNDLE --bus zenoh dds ros1 --pairs 8

A pair is a simulated base in one process and ``vlatool run vln`` in another, on a bus of their own (a port, a domain or
a ROS 1 master of this machine), in real time. The base plays the seeds of the pair one after another: it is put into
the next level with the instruction while the controller goes on. Whether it succeeded and stands is what the world
says; the actions and the end of a task are those of the records that the controller sends. The same seeds are then
played in one process, as ``mobile.py vln`` does. Several pairs mostly wait, side by side. BUNDLE is the int8 bundle of
``sample_models/vln-babyai``. Episodes whose worlds fell behind real time by more than a quarter, on a busy machine, are
played again by the next run with the same folder. Ends with 1 where one in real time ended otherwise than in one
process, or where none was in real time.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parent))

from _ros1 import Master, free_port, prepare
from _vln_episodes import (
    ENDED,
    FIRST_SEED,
    LIMIT_S,
    REST_S,
    ROOT,
    EpisodeEnd,
    continuous_episode,
    end_of,
    rate_of,
    stands,
)

from vlatool.buses import QoS, Reception, open_bus
from vlatool.messages.std_msgs import String
from vlatool.nodes.step_record import STEPS, StepRecord, topic_of
from vlatool.nodes.world_node import WorldNode
from vlatool.worlds import open_world

BUSES = ("zenoh", "dds", "ros1")
NODE = "vlatool_vln"
FIRST_DOMAIN = 120
"""DDS domain of the first pair; each further one has the next."""
JOIN_S = 60.0
"""How long a controller may take to begin, in seconds."""
LATE = "the policy is late"
MAX_BEHIND = 0.25
"""Share of an episode by which its world may fall behind real time; where it is more, the processor was taken away, and
waits in real time, such as ``motion_s`` of the controller, mean something else to it."""


class Timing(NamedTuple):
    """How an episode went in real time.

    Args:
        steps: Steps of the controller.
        skipped: Steps that were left out because those before them took too long.
        late_ms: How late the latest step began.
        late_policy: Steps at which the policy had no answer within its deadline.
        behind_s: Real time of the episode beyond its simulated time.
    """

    steps: int = 0
    skipped: int = 0
    late_ms: float = 0.0
    late_policy: int = 0
    behind_s: float = 0.0


class Judge:
    """Hears the records of the controller's steps, from the one at which it heard the instruction."""

    def __init__(self, bus: Any) -> None:
        self._came = threading.Condition()
        self._records: list[StepRecord] = []
        self._wants_instruction = False
        bus.subscribe(topic_of(NODE, STEPS), String, self._take, QoS(reliable=True, depth=100))

    def _take(self, got: Reception) -> None:
        text: Any = got.message
        record = StepRecord.from_json(text.data)
        with self._came:
            if self._wants_instruction and not record.readings.get("instruction"):
                return
            self._wants_instruction = False
            self._records.append(record)
            self._came.notify_all()

    def wait_for_controller(self) -> None:
        """Wait until a controller makes steps."""
        with self._came:
            if not self._came.wait_for(lambda: bool(self._records), JOIN_S):
                raise SystemExit(f"no controller made a step within {JOIN_S:g} s")

    def begin(self) -> None:
        """Forget all records, and those that come before one with an instruction."""
        with self._came:
            self._records, self._wants_instruction = [], True

    def records(self) -> list[StepRecord]:
        """Return the records of this task so far."""
        with self._came:
            return list(self._records)


def has_ended(records: list[StepRecord]) -> bool:
    """Whether the controller has ended its task by itself."""
    return bool(records) and records[-1].status.partition(" ")[0] in ENDED


def actions_of(records: list[StepRecord]) -> tuple[str, ...]:
    """Return the actions of the policy: the status says the motion at the step at which their number grows."""
    actions: list[str] = []
    for record in records:
        if int(record.notes.get("actions", 0)) > len(actions):
            motion = record.status.partition(" ")[2]
            actions.append("forward" if motion == "blocked" else motion)
    return tuple(actions)


def played(world: Any, node: WorldNode, judge: Judge, seed: int) -> tuple[EpisodeEnd, Timing]:
    """Play an episode."""
    judge.begin()
    world.reset(seed)
    began = time.monotonic()
    while not has_ended(judge.records()) and world.time_s < LIMIT_S:
        node.run(0.5)
    seconds, behind_s = world.time_s, time.monotonic() - began - world.time_s
    records = judge.records()
    node.run(REST_S)
    truth = world.truth()
    stopped = has_ended(judge.records()) and stands(truth)
    end = EpisodeEnd(seed, truth["arrived"], stopped, actions_of(records), truth["collisions"], seconds)
    late = sum(record.status.endswith(LATE) for record in records)
    latest_ms = max((record.late_ms for record in records), default=0.0)
    skipped = sum(record.skipped for record in records)
    return end, Timing(len(records), skipped, latest_ms, late, round(behind_s, 3))


def run_world(address: str, task: str, seeds: list[int]) -> None:
    """Be the world of a pair: print what its controller has to know, then a line of JSON for each episode."""
    world: Any = open_world("babyai", task=task)
    bus = open_bus(address, "vlatool_babyai")
    node, judge = WorldNode(world, bus, seeds[0]), Judge(bus)
    print(json.dumps({"max_actions": world.max_actions}), flush=True)
    judge.wait_for_controller()
    for seed in seeds:
        end, timing = played(world, node, judge, seed)
        print(json.dumps({"end": asdict(end), "timing": timing._asdict()}), flush=True)
    bus.close()


@dataclass(frozen=True)
class Place:
    """Where a pair meets: addresses of the world and of the controller, and their environment."""

    world: str
    controller: str
    environment: dict[str, str]


@contextlib.contextmanager
def place(bus: str, number: int, folder: Path) -> Iterator[Place]:
    """Yield where the pair with this number meets; other ROS variables than ours do not count."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "ZENOH_", "CYCLONE"))}
    if bus == "zenoh":
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        yield Place(f"zenoh:router/{endpoint}", f"zenoh:{endpoint}", plain)
    elif bus == "dds":
        address = f"dds:{FIRST_DOMAIN + number}@127.0.0.1"
        yield Place(address, address, plain)
    else:
        environment = {**prepare(folder), "ROS_IP": "127.0.0.1"}
        master = Master(folder, environment)
        try:
            yield Place(f"ros1:{master.uri}", f"ros1:{master.uri}", environment)
        finally:
            master.kill()


def play_pair(bus: str, number: int, seeds: list[int], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Play episodes in a pair of processes; return the lines of its world."""
    with contextlib.ExitStack() as stack:
        meeting = stack.enter_context(place(bus, number, options.output / "ros1"))
        log = stack.enter_context((options.output / f"{bus}-{number}.log").open("w"))
        seeds_text = [str(seed) for seed in seeds]
        world = stack.enter_context(process(
            [__file__, "--world", meeting.world, "--task", options.task, "--seeds", *seeds_text],
            meeting, log, stdout=subprocess.PIPE))  # fmt: skip
        lines = map(json.loads, world.stdout or ())
        first = next(lines, None)
        if first is None:
            raise SystemExit(f"the world of {bus} ended; {log.name} says why")
        run = ["-m", "vlatool.cli", "run", "vln", "--bundle", str(options.bundle), "--robot", "turtlebot4", "--bus",
               meeting.controller, "--max-actions", str(first["max_actions"]), "--threads", "1"]  # fmt: skip
        stack.enter_context(process(run, meeting, log, stdout=log))
        found = []
        for line in lines:
            found.append(line)
            with (options.output / f"{bus}.jsonl").open("a") as file:
                file.write(f"{json.dumps(line)}\n")
        if len(found) != len(seeds):
            raise SystemExit(f"{len(found)} of {len(seeds)} episodes over {bus}; {log.name} says why")
        return found


@contextlib.contextmanager
def process(arguments: list[str], meeting: Place, log: IO[str], stdout: Any) -> Iterator[subprocess.Popen[str]]:
    """Run Python in a process that is asked to end, and then ended, at the end."""
    child = subprocess.Popen(
        [sys.executable, *arguments], env=meeting.environment, cwd=ROOT, stdout=stdout, stderr=log, text=True
    )
    try:
        yield child
    finally:
        child.send_signal(signal.SIGTERM)
        try:
            child.wait(10)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        if child.stdout is not None:
            child.stdout.close()


def play_bus(bus: str, seeds: list[int], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Play all episodes over one bus, in several pairs at once; return the lines in the order of the seeds."""
    kept = in_real_time(bus, seeds, options)
    seeds = [seed for seed in seeds if seed not in kept]
    pairs = min(options.pairs, len(seeds))
    if bus == "ros1":
        prepare(options.output / "ros1")  # before the pairs, which would all do so
    with ThreadPoolExecutor(max(pairs, 1)) as threads:
        parts = threads.map(lambda number: play_pair(bus, number, seeds[number::pairs], options), range(pairs))
        kept |= {line["end"]["seed"]: line for part in parts for line in part}
    return [kept[seed] for seed in sorted(kept)]


def in_real_time(bus: str, seeds: list[int], options: argparse.Namespace) -> dict[int, dict[str, Any]]:
    """Return the episodes of earlier runs whose worlds kept up with real time, by seed."""
    file = options.output / f"{bus}.jsonl"
    lines = map(json.loads, file.read_text().splitlines() if file.exists() else ())
    return {line["end"]["seed"]: line for line in lines if line["end"]["seed"] in seeds and kept_up(line)}


def kept_up(line: dict[str, Any]) -> bool:
    """Whether the world of an episode kept up with real time."""
    share: float = line["timing"]["behind_s"] / line["end"]["seconds"]
    return share <= MAX_BEHIND


def compared(bus: str, lines: list[dict[str, Any]], expected: list[EpisodeEnd]) -> int:
    """Print how episodes over a bus ended beside those in one process; return how many in real time ended otherwise."""
    ends = [end_of(line["end"]) for line in lines]
    timings = [Timing(**line["timing"]) for line in lines]
    pairs = list(zip(ends, expected, strict=True))
    other = [pair for pair in pairs if (pair[0].success, pair[0].stopped) != (pair[1].success, pair[1].stopped)]
    slow = {line["end"]["seed"] for line in lines if not kept_up(line)}
    counted = [pair for pair in other if pair[0].seed not in slow]
    same = sum(one.actions == two.actions for one, two in pairs)
    as_many = sum(len(one.actions) == len(two.actions) for one, two in pairs)
    seconds, expected_seconds = (sum(end.seconds for end in each) / len(each) for each in (ends, expected))
    print(f"{bus}\n  success over the bus: {rate_of(ends)}\n  in one process:       {rate_of(expected)}")
    print(f"  the same outcome in {len(pairs) - len(other)}, as many actions in {as_many}, the same actions in {same}; "
          f"stopped by itself in {sum(end.stopped for end in ends)}, {sum(end.collisions for end in ends)} collisions, "
          f"{seconds:.1f} s each ({expected_seconds:.1f} in one process)")  # fmt: skip
    print(f"  {sum(each.steps for each in timings)} steps of the controller, {sum(each.skipped for each in timings)} "
          f"left out, the latest {max(each.late_ms for each in timings):.0f} ms late; the policy was late at "
          f"{sum(each.late_policy for each in timings)}; worlds up to {max(each.behind_s for each in timings):.2f} s "
          f"behind real time\n  {len(slow)} episodes not in real time, among them {len(other) - len(counted)} of the "
          f"{len(other)} that ended otherwise", flush=True)  # fmt: skip
    for one, two in pairs:
        if one.actions != two.actions or (one, two) in other:
            print(f"  over {bus}:     {one}\n  in one process: {two}")
    return len(counted)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--bundle", type=Path)
    parser.add_argument("--task", default="GoToLocalS6N3")
    parser.add_argument("--bus", nargs="+", choices=BUSES, default=list(BUSES), help="buses, one after another")
    parser.add_argument("--pairs", type=int, default=8, help="pairs of processes at once")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "out/vln-over-buses", help="folder of the results")
    parser.add_argument("--world", default="", help=argparse.SUPPRESS)
    parser.add_argument("--seeds", type=int, nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.world:
        run_world(options.world, options.task, options.seeds)
        sys.stdout.flush()
        os._exit(0)  # a thread of rospy may wait for its master
    if options.bundle is None:
        parser.error("--bundle is missing")
    from vlatool import load

    options.output.mkdir(parents=True, exist_ok=True)
    options.bundle, options.output = options.bundle.resolve(), options.output.resolve()
    seeds = [FIRST_SEED + options.first + number for number in range(options.episodes)]
    over_buses = {bus: play_bus(bus, seeds, options) for bus in options.bus}
    policy = load(options.bundle, threads=1)
    expected = [continuous_episode(options.task, seed, policy) for seed in seeds]
    otherwise = sum(compared(bus, lines, expected) for bus, lines in over_buses.items())
    return int(otherwise > 0 or not all(any(map(kept_up, lines)) for lines in over_buses.values()))


if __name__ == "__main__":
    sys.exit(main())
