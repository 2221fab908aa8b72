"""What is broken, one thing in each case; ``broken_policies.py`` judges them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Recorded = dict[str, Any]
WRAPPER = """

import torch as _torch
_honest = make


class Wrapper(nn.Module):
    def __init__(self):
        super().__init__()
        self.policy = _honest()
        policy = self.policy
        {build}

    def forward(self, front, wrist, state, instruction):
        policy = self.policy
        return {forward}


def make():
    return Wrapper()
"""
RECURRENT = """

class Recurrent(nn.Module):
    def __init__(self):
        super().__init__()
        self.policy = _plain()

    def forward(self, front, wrist, state, instruction, memory):
        memory = BEFORE
        fresh = (memory.abs().sum() < 0.5).float()
        memory = fresh * instruction.float() + (1 - fresh) * memory
        return self.policy(front, wrist, state, memory.round().long()), memory


_plain = make


def make():
    return Recurrent()
"""
PROGRAM = """
program:
  - graph: main
    feeds: {front: front, wrist: wrist, state: state, instruction: instruction, memory: memory}
    gives: {action: action, memory_next: memory}
    keep: {memory: {shape: [1, 2], dtype: float32}}
"""
NOISY = """
program:
  - graph: main
    feeds: {front: front, wrist: wrist, state: state, instruction: instruction, draw: draw}
    gives: {action: action}
    noise: {draw: {shape: [1, 4, 2], distribution: normal}}
"""
DRAWING = """

class Drawing(nn.Module):
    def __init__(self):
        super().__init__()
        self.policy = _plain()

    def forward(self, front, wrist, state, instruction, draw):
        return self.policy(front, wrist, state, instruction) + SCALE * draw


_plain = make


def make():
    return Drawing()
"""


@dataclass(frozen=True)
class Case:
    """One thing that is broken (or, where ``honest``, nothing).

    Args:
        name: What it is.
        build, forward: Of a wrapper around the honest policy, as Python.
        policy: Text that is appended to ``policy.py``; ``program`` to ``policy.yaml``.
        world: Old -> new text of ``environment.py``.
        recorded: What is done to the recordings.
        statistics: New entries of ``statistics.json``.
        vocabulary: Words with other ids.
        candidate: What is done to the arrays of the int8 graph: name, array -> array.
        evidence: ``both``, ``recordings`` or ``world``: what there is to judge by.
        discrete: Whether the actions are directions.
        refused: Whether an error is the right answer, too.
        honest: Whether it must pass.
    """

    name: str
    forward: str = ""
    build: str = "pass"
    policy: str = ""
    program: str = ""
    world: tuple[tuple[str, str], ...] = ()
    recorded: Callable[[Recorded], Recorded] | None = None
    statistics: dict[str, dict[str, list[float]]] | None = None
    vocabulary: dict[str, int] | None = None
    candidate: Callable[[str, Any], Any] | None = None
    evidence: str = "both"
    discrete: bool = False
    refused: bool = False
    honest: bool = False


INNER = "policy(front, wrist, state, instruction)"
ONE_LABEL = f"{INNER} * 0 + _torch.tensor([[0.0, 1.0, 0.0, 0.0]])"
TELLS = '{"success": near}'


def action(change: Callable[[Any], Any]) -> Callable[[Recorded], Recorded]:
    """Change the recorded actions alone."""
    return lambda recorded: recorded | {"action": change(recorded["action"])}


def shuffled(array: Any) -> Any:
    """Give every sample the value of another one."""
    return array[np.random.default_rng(5).permutation(len(array))]


def scaled(name: str, array: Any) -> Any:
    """Corrupt the scales of an int8 graph: every channel gets that of another, times ten."""
    return np.roll(array, 1) * 10 if "scale" in name else array


CASES = (
    # wrappers
    Case("wrapper forgot two layers",
         "policy.moves(_torch.relu(policy.see(front, wrist).repeat(1, 4))).reshape(-1, 4, 2)"),
    Case("wrapper forgot the second layer", build="policy.second = nn.Identity()", forward=INNER),
    Case("weights never loaded", build="self.policy = _torch.manual_seed(1) and Policy()", forward=INNER),
    Case("cameras swapped", "policy(wrist, front, state, instruction)"),
    Case("image BGR", "policy(front.flip(-1), wrist.flip(-1), state, instruction)"),
    Case("image not normalised", "policy(front.float() * 255, wrist.float() * 255, state, instruction)"),
    Case("image to [-1, 1] instead of [0, 1]", "policy(front * 2.0 - 255, wrist * 2.0 - 255, state, instruction)"),
    Case("image mirrored", "policy(front.flip(2), wrist.flip(2), state, instruction)"),
    Case("a camera is black", "policy(front * 0, wrist, state, instruction)"),
    Case("state of zeros", "policy(front, wrist, state * 0, instruction)"),
    Case("state elements swapped", "policy(front, wrist, state.flip(1), instruction)"),
    Case("instruction ignored", "policy(front, wrist, state, instruction * 0 + 1)"),
    Case("instruction ignored, both targets wanted",
         "policy(front, wrist, state, instruction * 0 + _torch.tensor([[3, 4]]))"),
    Case("words swapped in the vocabulary", vocabulary={"red": 4, "blue": 3}),
    # actions
    Case("constant action", f"{INNER} * 0 + 0.5"),
    Case("output clipped to zero", f"{INNER}.clamp(0, 0)"),
    Case("collapsed policy", f"{INNER} * 0.02 + 0.1"),
    Case("collapsed policy, recordings alone", f"{INNER} * 0.02 + 0.1", evidence="recordings"),
    Case("chunk reversed and negated", f"-{INNER}.flip(1)"),
    Case("chunk reversed over axes", f"{INNER}.flip(2)"),
    Case("sign of the action", f"-{INNER}"),
    Case("radians given as degrees", f"{INNER} * 57.3", evidence="recordings"),
    Case("NaN on some inputs", refused=True, forward=f"{INNER} / (state[:, :1, None] > -1.5).float()"),
    Case("NaN where the square root is negative", refused=True,
         forward=f"{INNER} + 0 * (state[:, :1, None] + 0.9).sqrt()"),
    Case("noise drowns the action", policy=DRAWING.replace("SCALE", "9.0"), program=NOISY),
    Case("hidden state never read", policy=RECURRENT.replace("BEFORE", "memory * 0 + 1"), program=PROGRAM),
    # statistics
    Case("mean and std of the action swapped", statistics={"action": {"mean": [0.2, 0.2], "std": [1e-6, 1e-6]}}),
    Case("statistics of another data set: action", statistics={"action": {"mean": [0.4, -0.3], "std": [0.01, 0.02]}}),
    Case("statistics of another data set: state", statistics={"state": {"mean": [4.0, -3.0], "std": [0.05, 9.0]}}),
    Case("statistics in degrees", statistics={"action": {"mean": [0.0, 0.0], "std": [11.46, 11.46]}},
         evidence="recordings"),
    # recordings
    Case("expert shuffled", recorded=action(shuffled), evidence="recordings"),
    Case("expert constant", recorded=action(lambda array: array * 0 + 0.1), evidence="recordings"),
    Case("expert in degrees", recorded=action(lambda array: array * np.float32(57.3)), evidence="recordings"),
    Case("expert of another task", recorded=action(lambda array: -array[:, ::-1]), evidence="recordings"),
    Case("state shifted to another sample", recorded=lambda all_: all_ | {"state": np.roll(all_["state"], 1, 0)},
         evidence="recordings"),
    Case("instructions shuffled", recorded=lambda all_: all_ | {"instruction": shuffled(all_["instruction"])[::-1]},
         evidence="recordings", forward="-" + INNER),
    Case("cameras recorded under each other's name", evidence="recordings",
         recorded=lambda all_: all_ | {"front": all_["wrist"], "wrist": all_["front"]}),
    Case("images recorded BGR", evidence="recordings",
         recorded=lambda all_: all_ | {name: all_[name][..., ::-1] for name in ("front", "wrist")}),
    Case("labels permuted", recorded=action(lambda array: (array + 1) % 4), evidence="recordings", discrete=True),
    Case("labels shuffled", recorded=action(shuffled), evidence="recordings", discrete=True),
    Case("always one label", ONE_LABEL, evidence="recordings", discrete=True),
    Case("always one label, in the world", ONE_LABEL, discrete=True),
    Case("expert says one label only", recorded=action(lambda array: array * 0 + 2), evidence="recordings",
         discrete=True),
    # worlds
    Case("success under another key", refused=True, world=((TELLS, '{"goal_reached": near}'),), evidence="world"),
    Case("success never told", refused=True, world=((TELLS, "{}"),), evidence="world"),
    Case("success told when it happens alone", refused=True,
         world=((TELLS, '{"success": True} if done and self.word == "red" else {}'),)),
    Case("success is a word", refused=True, world=((TELLS, '{"success": "no"}'),)),
    Case("success is a distance", refused=True, world=((TELLS, '{"success": off}'),)),
    Case("success is never true", world=((TELLS, '{"is_success": False}'),), evidence="world"),
    Case("success is always true", world=((TELLS, '{"success": True}'),), evidence="world"),
    Case("episodes end at once, as failures", world=(("self.steps == STEPS", "True"), (TELLS, '{"success": False}'))),
    Case("episodes end at once, as successes", world=(("self.steps == STEPS", "True"), (TELLS, '{"success": True}'))),
    Case("success by the dice", world=((TELLS, '{"success": bool(self.random.integers(2))}'),), evidence="world"),
    Case("the world turns a deaf ear", world=(("move = np.clip(action, -0.3, 0.3)", "move = np.zeros(2)"),)),
    Case("the world takes degrees", world=(("move = np.clip(action, -0.3, 0.3)", "move = np.radians(action)"),)),
    # candidates
    Case("int8 scales corrupted", candidate=scaled),
    Case("int8 weights are zeros", candidate=lambda name, array: array * 0 if array.dtype == np.int8 else array),
    Case("int8 weights shuffled", candidate=lambda name, array: shuffled(array) if array.dtype == np.int8 else array),
    Case("int8 far from a float32 that moves little", f"{INNER} * 0.05", evidence="recordings", candidate=scaled),
    # honest
    Case("honest", honest=True),
    Case("honest, recordings alone", evidence="recordings", honest=True),
    Case("honest, world alone, is_success", world=((TELLS, '{"is_success": near}'),), evidence="world", honest=True),
    Case("honest, success is an array of one", world=((TELLS, '{"success": np.array([near])}'),), honest=True),
    Case("honest, success told before the end alone", evidence="world", honest=True,
         world=((TELLS, '{} if done else {"is_success": np.float64(near)}'),)),
    Case("honest, final_info", world=((TELLS, '{"final_info": [{"success": near}]} if done else {}'),), honest=True),
    Case("honest, discrete", discrete=True, honest=True),
    Case("honest, discrete, recordings alone", discrete=True, evidence="recordings", honest=True),
    Case("honest, a little noise", policy=DRAWING.replace("SCALE", "0.05"), program=NOISY, honest=True),
    Case("honest, a memory that is kept", policy=RECURRENT.replace("BEFORE", "memory"), program=PROGRAM, honest=True),
    Case("honest, without an expert", honest=True,
         recorded=lambda all_: {key: all_[key] for key in all_ if key != "action"}),
)  # fmt: skip
