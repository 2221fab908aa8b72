"""Simulated arms and their controllers as processes on a bus: targets, service, kills of either, refusals.

    python tests/validation/robots/arms_over_bus.py -o out/reach [--only aloha] [--bus zenoh dds]

OUT is the folder of ``reach_policies.py``, which makes models and int8 bundles. For each robot and bus, three
processes: ``vlatool sim``, ``vlatool run`` and this one, an operator that publishes targets once and looks at joint
states, commands and records of steps. Prints a table; exits with 1 when a line of it failed.
"""

from __future__ import annotations

import argparse
import json
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _arm_processes import Operator, Process, open_operator
from _bus_trials import Row, finish
from _reach_training import Task
from reach_policies import NEAR_M, SLACK, WORLDS

from vlatool.errors import BusError
from vlatool.registry import load

ROBOTS = {"franka": "franka-panda", "ur5e": "ur5e", "so101": "so101", "aloha": "aloha"}
"""Controller -> robot whose limits its policy keeps."""
REACH_S, ACTING_S, RESTART_S, LEASE_S = 10.0, 40.0, 3.0, 15.0
"""Time to a target, to the start pose, until joint states are told to be old, and until a dead node is forgotten."""
SLOW_S = 6.0
"""Time that a slow way takes at least: longer than the five seconds that a call of a service usually waits."""
TARGETLESS = ("acting: no target", "acting: no left_target")
START_RAD = 0.1
"""Distance from the start pose at which an arm is there: servos sag."""

STAYS = '''"""Asks for the positions that it sees, and looks at a picture."""

import torch
from torch import Tensor, nn


class Stays(nn.Module):
    """Positions as they are."""

    def forward(self, state: Tensor, wrist: Tensor) -> Tensor:
        """State (B, A), wrist (B, H, W, 3) -> actions (B, 1, A)."""
        return (state + 0.0 * wrist.float().mean()).unsqueeze(1)


def make() -> nn.Module:
    """Builds the policy in eval mode."""
    return Stays().eval()
'''


@dataclass
class Trial:
    """One robot on one bus.

    Args:
        name: Name of the controller.
        world_bus, bus: Bus of the simulated robot and of the others, as a user types them.
        output: Folder with models, bundles, and the logs of the processes.
    """

    name: str
    world_bus: str
    bus: str
    output: Path

    def __post_init__(self) -> None:
        self.controller = load("controllers", self.name)
        self.robot = self.controller.ROBOT
        self.rows: list[Row] = []
        self.targets = Task(self.name, self.controller, 40, seed=7).targets
        self._count = 0

    def add(self, what: str, result: str, passed: bool) -> None:
        """Remember a line, and print it."""
        self.rows.append(Row(f"{self.name}, {self.bus.partition(':')[0]}: {what}", result, passed))
        print(f"{'pass' if passed else 'FAIL'}  {self.rows[-1].trial}: {result}", flush=True)

    def world(self, seed: int) -> Process:
        """Start the simulated robot."""
        return self._start(["sim", WORLDS[self.name].replace("_", "-"), "--bus", self.world_bus, "--json",
                            "--seed", str(seed), "--models", str(self.output / "models")])  # fmt: skip

    def controls(self, *more: str, bundle: Path | None = None) -> Process:
        """Start a controller."""
        return self._start(["run", self.name, "--bundle", str(bundle or self.output / self.name / "int8"), "--robot",
                            ROBOTS[self.name], "--bus", self.bus, "--threads", "1", *more])  # fmt: skip

    def _start(self, command: list[str]) -> Process:
        self._count += 1
        folder = self.output / "bus" / f"{self.name}-{self.bus.partition(':')[0]}"
        folder.mkdir(parents=True, exist_ok=True)
        return Process(command, folder / f"{self._count:02}-{command[0]}.out")

    def excess(self, process: Process) -> tuple[float, float]:
        """Return by how much simulated joints, not grippers, left limits of position and velocity."""
        truth = json.loads(process.answer)["truth"]
        columns = zip(
            self.robot.limits().joints, *(truth[name] for name in ("lowest", "highest", "fastest")), strict=True
        )
        over = [
            (max(joint.bounds[0] - low, high - joint.bounds[1]), fast - joint.velocity[1])
            for joint, low, high, fast in columns
            if joint.command != "range"
        ]
        position, velocity = (max(0.0, *column) for column in zip(*over, strict=True))
        return position, velocity


def reach(trial: Trial, operator: Operator, target: np.ndarray, what: str, *, publish: bool = True) -> None:
    """Publish a target once, and wait until the tip is there and stands."""
    if publish:
        operator.aim(target)
    took = operator.wait(lambda: operator.distance(target) < NEAR_M and operator.stands(0.5), REACH_S)
    result = f"{operator.distance(target) * 1e3:.1f} mm after {took:.1f} s; {operator.status}"
    trial.add(what, result, np.isfinite(took))


def begins(trial: Trial, operator: Operator) -> None:
    """A controller goes to the start pose, and says that it has no target."""
    took = operator.wait(lambda: operator.status in TARGETLESS and operator.stands(0.3), ACTING_S)
    away = float(np.abs(operator.positions() - trial.robot.start).max())
    right = np.isfinite(took) and away < START_RAD
    trial.add("at the start pose, without a target", f"after {took:.1f} s, {away:.3f} rad; {operator.status}", right)


def second_is_refused(trial: Trial) -> None:
    """Another controller, under the same name and under one of its own, ends at once with what is wrong."""
    for more in ((), ("--node", "another")):
        with trial.controls(*more) as second:
            code = second.exit_code(30.0)
            words = " ".join(second.said.split())
        trial.add("a second controller is refused", f"exit {code}: {words[:150]}", code == 3 and "publisher" in words)


def goes_back(trial: Trial, operator: Operator, what: str = "~/return_to_start", least_s: float = 0.0) -> None:
    """The service answers when the arm is at its start pose."""
    began = time.monotonic()
    try:
        answer = operator.return_to_start(120.0)
    except BusError as error:
        trial.add(what, f"after {time.monotonic() - began:.1f} s: {error}", False)
        return
    away = float(np.abs(operator.positions() - trial.robot.start).max())
    took = time.monotonic() - began
    result = f"{answer.success}, '{answer.message}' after {took:.1f} s, {away:.3f} rad away"
    trial.add(what, result, answer.success and away < START_RAD and took >= least_s)


def goes_back_slowly(trial: Trial, operator: Operator) -> None:
    """A call waits for a way that takes longer than calls usually do."""
    operator.statuses.clear()
    with trial.controls("--speed", "0.03", "--no-return-at-start") as controller:
        operator.wait(lambda: operator.status.startswith("acting"), ACTING_S)
        goes_back(trial, operator, "~/return_to_start, slowly", least_s=SLOW_S)
        controller.end()


def controller_is_killed(trial: Trial, operator: Operator, controller: Process, target: np.ndarray) -> None:
    """Without its controller, the arm stops and stands where it was commanded last."""
    operator.aim(target)
    time.sleep(0.5)
    moving = float(np.abs(operator.velocities(time.monotonic() - 0.2)).max())
    controller.kill()
    killed_s = time.monotonic()
    time.sleep(2.5)
    after = operator.velocities(killed_s)
    fastest = np.abs(after).max(axis=0)
    limits = [np.inf if joint.command == "range" else joint.velocity[1] for joint in trial.robot.limits().joints]
    late = [each for each in operator.commands if each.time_s > killed_s + 0.2]
    away = float(np.abs(operator.positions() - operator.commands[-1].value).max())
    right = operator.stands(1.5) and not late and bool((fastest <= limits).all()) and away < START_RAD
    result = f"{moving:.2f} rad/s before, {np.abs(after[-100:]).max():.3f} at the end, {away:.3f} rad from the command"
    trial.add("kill -9 of the controller: the arm stands", result, right and moving > 0.05)


def next_controller(trial: Trial) -> Process:
    """Start controllers until one is not refused: the dead one's publisher is known for a while."""
    began, refusals = time.monotonic(), 0
    while True:
        started, process = time.monotonic(), trial.controls()
        while process.runs() and "runs:" not in process.said and time.monotonic() - started < 30.0:
            time.sleep(0.05)
        took = time.monotonic() - began
        if process.runs() or took > LEASE_S + 10.0:
            break
        refusals += 1
    result = f"it runs after {took:.1f} s and {refusals} refusals"
    trial.add("the next controller", result, process.runs() and took < LEASE_S + 5.0)
    return process


def world_is_killed(trial: Trial, operator: Operator, world: Process, target: np.ndarray) -> Process:
    """Without joint states, the controller follows its stop, sends nothing then, and goes on with the next robot."""
    operator.aim(target)
    time.sleep(0.5)
    world.kill()
    told = operator.wait(lambda: "joint state" in operator.status and "old" in operator.status, RESTART_S)
    time.sleep(1.5)
    last, before = operator.commands[-1], operator.commands[-2]
    rests = bool((last.value == before.value).all()) and time.monotonic() - last.time_s > 0.3
    result = f"told after {told:.1f} s; commands {'rest' if rests else 'do not rest'}; {operator.status}"
    trial.add("kill -9 of the robot: old joint states", result, bool(np.isfinite(told)) and rests)
    again = trial.world(seed=5)
    back = operator.wait(lambda: "old" not in operator.status and operator.status.startswith("acting"), 30.0)
    trial.add("it goes on when the robot is back", f"after {back:.1f} s: {operator.status}", bool(np.isfinite(back)))
    return again


def wrong_bundles_are_named(trial: Trial, operator: Operator) -> None:
    """A bundle of another robot is refused by the joints; one with a camera that the robot lacks waits, and says so."""
    other = next(name for name in ROBOTS if name != trial.name)
    with trial.controls(bundle=trial.output / other / "int8") as process:
        code, words = process.exit_code(30.0), " ".join(process.said.split())
    trial.add("a bundle of another robot", f"exit {code}: {words[:150]}", code == 2 and trial.robot.joints[0] in words)
    operator.statuses.clear()
    with trial.controls(bundle=camera_bundle(trial)) as process:
        took = operator.wait(lambda: "camera wrist: no image" in operator.status, ACTING_S)
        words = " ".join(process.said.split())
        process.end()
    trial.add("a bundle with a camera that the robot lacks", f"{operator.status}; {words[-100:]}",
              bool(np.isfinite(took)) and "nobody publishes /wrist/image_raw" in words)  # fmt: skip


def camera_bundle(trial: Trial) -> Path:
    """Return the bundle of a policy that stays where it is and sees a camera."""
    folder = trial.output / "bus" / f"camera-{trial.name}"
    folder.mkdir(parents=True, exist_ok=True)
    labels, units = zip(*((joint.name, joint.unit) for joint in trial.robot.limits().joints), strict=True)
    joints = {"dtype": "float32", "labels": labels, "unit": units}
    spec = {
        "inputs": [{"name": "state", "shape": [1, len(labels)], **joints},
                   {"name": "wrist", "shape": [1, 48, 64, 3], "dtype": "uint8"}],
        "outputs": [{"name": "action", "shape": [1, 1, len(labels)], "mode": "absolute", **joints}],
        "control_hz": 30 if trial.name == "so101" else 50, "chunk": 1,
    }  # fmt: skip
    document = {"schema": 1, "name": "stays", "version": "1.0.0", "source": "policy.py:make", "spec": spec}
    (folder / "policy.yaml").write_text(json.dumps(document))  # JSON is YAML
    (folder / "policy.py").write_text(STAYS)
    command = ["export", "onnx", str(folder), "-o", str(folder / "bundle"), "--force"]
    subprocess.run([sys.executable, "-m", "vlatool", *command], check=True, capture_output=True)
    return folder / "bundle"


def ends(trial: Trial, world: Process, controller: Process) -> None:
    """Signals end both, and no simulated joint left its limits."""
    codes = controller.end(signal.SIGINT), world.end(signal.SIGTERM)
    trial.add("Ctrl-C and SIGTERM", f"exit codes {codes[0]} and {codes[1]}", codes == (130, 0))
    if world.answer.strip():
        position, velocity = trial.excess(world)
        right = position <= SLACK["position"] and velocity <= SLACK["velocity"]
        trial.add("limits of the simulated joints", f"beyond by {position:.2g} rad, {velocity:.2g} rad/s", right)
    else:
        trial.add("limits of the simulated joints", "the robot did not say", False)


def play(trial: Trial) -> list[Row]:
    """Go through all of it with one robot on one bus."""
    one, two, three = trial.targets[:3]
    world, controller = trial.world(seed=1), None
    operator = open_operator(trial.bus, trial.name, trial.robot)
    try:
        operator.wait(lambda: bool(operator.states), 20.0)
        wrong_bundles_are_named(trial, operator)
        operator.statuses.clear()
        controller = trial.controls()
        begins(trial, operator)
        reach(trial, operator, one, "a target that is published once")
        second_is_refused(trial)
        goes_back(trial, operator)
        reach(trial, operator, two, "the next target")
        controller_is_killed(trial, operator, controller, three)
        operator.statuses.clear()
        controller = next_controller(trial)
        begins(trial, operator)
        reach(trial, operator, three, "a target after it")
        world = world_is_killed(trial, operator, world, one)
        reach(trial, operator, one, "the target of before the kill", publish=False)
        controller.end()
        goes_back_slowly(trial, operator)
        controller = next_controller(trial)
        goes_back(trial, operator)
        ends(trial, world, controller)
    finally:
        operator.close()
        for process in (controller, world):
            if process is not None and process.runs():
                process.kill()
    return trial.rows


def free_port() -> int:
    """Return a port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def trials(name: str, bus: str, output: Path) -> list[Row]:
    """Return the lines of one robot on one bus."""
    buses: dict[str, Any] = {"dds": lambda: ("dds:97@127.0.0.1",) * 2}
    port = free_port()
    buses["zenoh"] = lambda: (f"zenoh:router/tcp/127.0.0.1:{port}", f"zenoh:tcp/127.0.0.1:{port}")
    return play(Trial(name, *buses[bus](), output))


def main() -> int:
    """Try each robot on each bus; 1 where something failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=[*ROBOTS], default=[*ROBOTS])
    parser.add_argument("--bus", nargs="*", choices=["zenoh", "dds"], default=["zenoh", "dds"])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/reach"))
    options = parser.parse_args()
    rows = [row for name in options.only for bus in options.bus for row in trials(name, bus, options.output)]
    return finish("arms over a bus", rows)


if __name__ == "__main__":
    raise SystemExit(main())
