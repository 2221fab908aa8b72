"""Policies that bring the tip of an arm to a place: the expert, the network, its training, and its policy directory."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.controllers._arm import ArmController
from vlatool.controllers._arm_robot import ArmRobot
from vlatool.runtime.kinematics import Chain, arm

GAIN, STEP_RAD = 0.12, 0.02
"""Share of the way to the goal in a step, and the longest step of a joint."""
DAMPING = 0.05
MAX_STEPS, BATCH = 24000, 128
BOXES = {
    "franka": {"": ((0.3, -0.3, 0.2), (0.6, 0.3, 0.7))},
    "ur5e": {"": ((0.3, -0.15, 0.2), (0.6, 0.35, 0.6))},
    "so101": {"": ((0.15, -0.12, 0.06), (0.32, 0.12, 0.25))},
    "aloha": {"left": ((-0.25, 0.35, 0.15), (-0.08, 0.65, 0.4)), "right": ((0.08, 0.35, 0.15), (0.25, 0.65, 0.4))},
}
"""Robot -> arm -> corners of the box in which targets lie, in metres in the world."""
POLICY = '''"""Brings the tips of {name} to targets: state and target in, joint deltas out."""

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from network import Reach

WEIGHTS = Path(__file__).with_name("weights.safetensors")


def make() -> nn.Module:
    """Builds the policy in eval mode, with its weights."""
    weights = load_file(WEIGHTS)
    policy = Reach({places}, weights["middle"].shape[0], {grippers}, {opening})
    policy.load_state_dict(weights)
    return policy.eval()
'''
NETWORK = f'''"""The network: where the joints should be, from where the tips should be, and a step on the way."""

import torch
from torch import Tensor, nn


class Reach(nn.Module):
    """One perceptron for each arm gives the joints for a place of its tip; the action is a bounded step towards them.

    Args:
        places: For each arm, the places of its joints in the state.
        width: Numbers of the target: three for each arm.
        grippers: Places of grippers, which get a position instead of a step.
        opening: That position.
    """

    def __init__(self, places: list[list[int]], width: int, grippers: list[int], opening: float) -> None:
        super().__init__()
        hidden = 256
        self.places, self.grippers, self.opening = places, grippers, opening
        self.register_buffer("middle", torch.zeros(width))
        self.register_buffer("extent", torch.ones(width))
        self.arms = nn.ModuleList(
            nn.Sequential(
                nn.Linear(3, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, len(own)),
            )
            for own in places
        )

    def goal(self, target: Tensor, arm: int) -> Tensor:
        """Target (B, W) in metres -> joints of an arm (B, N) in rad."""
        place = (target - self.middle) / self.extent
        return self.arms[arm](place[:, 3 * arm : 3 * arm + 3])

    def forward(self, state: Tensor, target: Tensor) -> Tensor:
        """State (B, A), target (B, W) -> actions (B, 1, A)."""
        columns = {{}}
        for arm, own in enumerate(self.places):
            step = {STEP_RAD} * torch.tanh({GAIN} / {STEP_RAD} * (self.goal(target, arm) - state[:, own]))
            columns |= {{place: step[:, index] for index, place in enumerate(own)}}
        for place in self.grippers:
            columns[place] = torch.full_like(state[:, 0], self.opening)
        return torch.stack([columns[place] for place in range(state.shape[1])], dim=1).unsqueeze(1)
'''


def chain_of(name: str, robot: ArmRobot, side: str) -> Chain:
    """Return the chain of the arm as the world has it."""
    return arm("ur5e_robosuite") if name == "ur5e" else robot.chains[side]


def solve(
    chain: Chain, start: np.ndarray, targets: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return joints (K, N) for tips (K, 3), from one start, and the distances that remain (K,)."""
    joints = np.tile(start, (len(targets), 1))
    for _ in range(50):
        error = targets - chain.tip_position(joints)
        error *= np.minimum(1.0, 0.05 / np.maximum(np.linalg.norm(error, axis=1, keepdims=True), 1e-9))
        jacobian = chain.jacobian(joints)[:, :3]
        square = jacobian @ np.swapaxes(jacobian, 1, 2) + DAMPING**2 * np.eye(3)
        joints = joints + (np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(square, error[..., None]))[..., 0]
        joints = np.clip(joints, low, high)
    return joints, np.linalg.norm(targets - chain.tip_position(joints), axis=1)


class Task:
    """The targets of a robot, and where its joints should be for them.

    Args:
        name: Name of the controller.
        controller: Its class.
        count: Targets to draw.
    """

    def __init__(self, name: str, controller: type[ArmController], count: int, seed: int) -> None:
        self.name, self.robot = name, controller.ROBOT
        built = controller()
        limits = self.robot.limits(built.speed, 2.0 * built.margin_rad).joints
        self.low, self.high = (np.array([joint.bounds[side] for joint in limits]) for side in (0, 1))
        self.places = [self.robot.places(side) for side in self.robot.chains]
        self.grippers = [index for index, joint in enumerate(limits) if joint.command == "range"]
        self.opening = float(np.mean([limits[index].bounds for index in self.grippers])) if self.grippers else 0.0
        random = np.random.default_rng(seed)
        targets, goals, good = [], [], np.ones(count, bool)
        for side, own in zip(self.robot.chains, self.places, strict=True):
            corners = np.array(BOXES[name][side])
            place = random.uniform(corners[0], corners[1], (count, 3))
            start = np.array(self.robot.start)[own]
            joints, left = solve(chain_of(name, self.robot, side), start, place, self.low[own], self.high[own])
            good &= left < 1e-3
            targets.append(place)
            goals.append(joints)
        apart = built._apart()
        self.targets, joints = np.concatenate(targets, axis=1), np.concatenate(goals, axis=1)
        whole = np.tile(np.array(self.robot.start), (count, 1))
        whole[:, [place for own in self.places for place in own]] = joints
        if apart is not None:
            good &= apart.distance(whole) > apart.minimum_m + 0.03
        self.share = float(good.mean())
        self.targets, self.goals, self.states = self.targets[good], joints[good], whole[good]


def train(task: Task, folder: Path, seconds: float) -> dict[str, float]:
    """Train by imitation of the expert, write the policy directory; return steps, seconds and the error left."""
    import torch
    from safetensors.torch import save_file

    torch.manual_seed(0)
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "network.py").write_text(NETWORK)
    scope: dict[str, Any] = {}
    exec(compile(NETWORK, "network.py", "exec"), scope)  # the file that is written beside it
    corners = [np.array(BOXES[task.name][side]) for side in task.robot.chains]
    policy = scope["Reach"](task.places, 3 * len(corners), task.grippers, task.opening)
    policy.middle.copy_(torch.tensor(np.concatenate([c.mean(axis=0) for c in corners]), dtype=torch.float32))
    policy.extent.copy_(torch.tensor(np.concatenate([np.ptp(c, axis=0) / 2 for c in corners]), dtype=torch.float32))
    targets, goals = (torch.tensor(values, dtype=torch.float32) for values in (task.targets, task.states))
    optimizer = torch.optim.Adam(policy.parameters(), 2e-3)
    begin, steps = time.process_time(), 0
    total = MAX_STEPS if seconds >= 60.0 else int(MAX_STEPS * seconds / 60.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total)
    moving = [place for own in task.places for place in own]
    while steps < total and time.process_time() - begin < seconds:
        rows = torch.randint(0, len(targets), (BATCH,))
        spread = 10.0 ** (-2.5 * torch.rand(BATCH, 1))
        states = goals[rows][:, moving] + spread * torch.randn(BATCH, len(moving))
        found = torch.cat([policy.goal(targets[rows], arm) for arm in range(len(task.places))], dim=1)
        action, expert = (torch.tanh(GAIN / STEP_RAD * (goal - states)) for goal in (found, goals[rows][:, moving]))
        loss = ((action - expert) ** 2).mean() + ((found - goals[rows][:, moving]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        steps += 1
    with torch.no_grad():
        found = torch.cat([policy.goal(targets, arm) for arm in range(len(task.places))], dim=1)
        left = float((found - goals[:, moving]).abs().max(dim=1).values.quantile(0.95))
    save_file(policy.state_dict(), folder / "weights.safetensors")
    _write(task, folder, policy)
    return {"steps": steps, "seconds": time.process_time() - begin, "error_rad": left}


def _write(task: Task, folder: Path, policy: Any) -> None:
    import torch

    random = np.random.default_rng(1)
    rows = random.integers(0, len(task.targets), 256)
    states = task.states[rows] + 10.0 ** random.uniform(-2.5, 0, (256, 1)) * random.standard_normal(
        (256, task.states.shape[1])
    )
    states, targets = states.astype(np.float32), task.targets[rows].astype(np.float32)
    with torch.no_grad():
        actions = policy(torch.tensor(states), torch.tensor(targets)).numpy()
    np.savez_compressed(folder / "calibration.npz", state=states[:128], target=targets[:128], action=actions[:128])
    np.savez_compressed(folder / "evaluation.npz", state=states[128:], target=targets[128:], action=actions[128:])
    joints = task.robot.limits().joints
    labels, units = [joint.name for joint in joints], [joint.unit for joint in joints]
    text = POLICY.format(name=task.name, places=task.places, grippers=task.grippers, opening=task.opening)
    (folder / "policy.py").write_text(text)
    spec = {
        "inputs": [
            {"name": "state", "shape": [1, len(labels)], "dtype": "float32", "labels": labels, "unit": units},
            {"name": "target", "shape": [1, targets.shape[1]], "dtype": "float32", "unit": "m"},
        ],
        "outputs": [
            {
                "name": "action",
                "shape": [1, 1, len(labels)],
                "dtype": "float32",
                "labels": labels,
                "unit": units,
                "mode": "delta",
            }
        ],
        "control_hz": 30 if task.name == "so101" else 50,
        "chunk": 1,
    }
    document = {"schema": 1, "name": f"reach-{task.name}", "version": "1.0.0", "source": "policy.py:make", "spec": spec}
    (folder / "policy.yaml").write_text(json.dumps(document, indent=1))  # JSON is YAML
