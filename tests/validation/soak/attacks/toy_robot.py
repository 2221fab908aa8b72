"""A robot so small that its policy can be written by hand: two cameras, a position, a word, and a target to reach.

``write_robot`` writes the folder of an honest policy with its recordings and its world; the tests of broken policies
damage copies of it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

POLICY_YAML = """\
schema: 1
name: toy
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {name: front, shape: [1, 8, 8, 3], dtype: uint8, unit: rgb}
    - {name: wrist, shape: [1, 8, 8, 3], dtype: uint8, unit: rgb}
    - {name: state, shape: [1, 2], unit: m, normalisation: mean_std, statistics: statistics.json#state}
    - {name: instruction, kind: text, shape: [1, 2], dtype: int64, tokenizer: vocabulary.json, max_tokens: 2}
  outputs:
    - OUTPUT
  control_hz: 10
  chunk: CHUNK
environment: {make: environment.py:make, tasks: [reach]}
"""
MOVES = """{name: action, shape: [1, 4, 2], unit: m, labels: [dx, dy], mode: delta,
       normalisation: mean_std, statistics: statistics.json#action}"""
LABELS = "{name: action, kind: discrete, shape: [1, 4], labels: [left, right, down, up]}"
WORLD_PY = '''\
"""A flat world: the front camera sees the columns of a red and a blue target, the wrist camera their rows."""

import numpy as np

STEPS = 14
NEAR = 0.2


def camera(places, random):
    """Place of each colour in [-1, 1] -> (8, 8, 3) uint8: red in the first channel, blue in the last."""
    image = random.integers(0, 3, (8, 8, 3)).astype(np.float64)
    for channel, place in ((0, places[0]), (2, places[1])):
        column = (place + 1) / 2 * 7
        left, row = min(int(column), 6), random.integers(8)
        image[row, left, channel] += 190 * (1 - (column - left))
        image[row, left + 1, channel] += 190 * (column - left)
    return image.astype(np.uint8)


def observed(targets, position, word, random):
    return {
        "front": camera(targets[:, 0], random), "wrist": camera(targets[:, 1], random),
        "state": position.astype(np.float32), "instruction": "go " + word,
    }


def expert(targets, position, word):
    """The right chunk (4, 2): towards the target that the word names, at most 0.3 in a step."""
    target, place, chunk = targets[0 if word == "red" else 1], position.copy(), []
    for _ in range(4):
        chunk.append(np.clip(target - place, -0.3, 0.3))
        place = place + chunk[-1]
    return np.array(chunk)


def direction(chunk):
    """The discrete action: left, right, down or up, along the longer way."""
    way = chunk.sum(axis=0)
    axis = int(abs(way[1]) > abs(way[0]))
    return 2 * axis + int(way[axis] > 0)


def draw(random):
    return random.uniform(-0.9, 0.9, (2, 2)), random.uniform(-0.9, 0.9, 2), ("red", "blue")[random.integers(2)]


class World:
    def reset(self, *, seed=None):
        self.random, self.steps = np.random.default_rng(seed), 0
        self.targets, self.position, self.word = draw(self.random)
        return observed(self.targets, self.position, self.word, self.random), {}

    def step(self, action):
        self.steps += 1
        if np.ndim(action) == 0:
            move = np.zeros(2)
            move[int(action) // 2] = 0.15 * (2 * (int(action) % 2) - 1)
        else:
            move = np.clip(action, -0.3, 0.3)
        self.position = np.clip(self.position + move, -1, 1)
        off = float(np.abs(self.position - self.targets[0 if self.word == "red" else 1]).max())
        near, done = off < NEAR, self.steps == STEPS
        observation = observed(self.targets, self.position, self.word, self.random)
        return observation, 0.0, done, False, {"success": near}

    def close(self):
        pass


def make(task="reach", instruction="right"):
    return World()
'''
POLICY_PY = '''\
"""Two cameras, a position and a word to a chunk of moves (or the logits of a direction)."""

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import nn

DISCRETE = False


class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.front, self.wrist = nn.Linear(192, 2), nn.Linear(192, 2)
        self.words = nn.Embedding(8, 4)
        self.first, self.second = nn.Linear(6, 16), nn.Linear(16, 16)
        self.moves, self.directions = nn.Linear(16, 8), nn.Linear(16, 4)

    def see(self, front, wrist):
        front, wrist = (image.flatten(1).float() / 255.0 for image in (front, wrist))
        return torch.cat([self.front(front), self.wrist(wrist)], 1)

    def forward(self, front, wrist, state, instruction):
        seen = self.see(front, wrist) * self.words(instruction).sum(1)
        hidden = torch.relu(self.first(torch.cat([seen, state], 1)))
        hidden = torch.relu(self.second(hidden))
        return self.directions(hidden) if DISCRETE else self.moves(hidden).reshape(-1, 4, 2)


def make():
    policy = Policy()
    policy.load_state_dict(load_file(str(Path(__file__).with_name("weights.safetensors"))))
    return policy
'''
VOCABULARY = {"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2, "red": 3, "blue": 4}}
STATISTICS = {"state": {"mean": [0.0, 0.0], "std": [0.5, 0.5]}, "action": {"mean": [0.0, 0.0], "std": [0.2, 0.2]}}


def module(path: Path) -> dict[str, Any]:
    """Run a Python file of the robot's folder and return its names."""
    found: dict[str, Any] = {"__file__": str(path), "__name__": path.stem}
    code = compile(path.read_text(encoding="utf-8"), str(path), "exec")
    exec(code, found)
    return found


def demonstrations(world: dict[str, Any], count: int, seed: int, discrete: bool = False) -> dict[str, Any]:
    """Recorded samples: what the robot saw, and what its expert did (with a hand that shakes a little)."""
    random = np.random.default_rng(seed)
    drawn = [world["draw"](random) for _ in range(count)]
    seen = [world["observed"](*each, random) for each in drawn]
    right = [world["expert"](*each) for each in drawn]
    recorded = {name: np.array([each[name] for each in seen]) for name in seen[0]}
    if discrete:
        return recorded | {
            "action": np.array([world["direction"](each) for each in right]),
            "episode": np.arange(count) // 4,
        }
    action = (np.array(right) + random.normal(0, 0.01, (count, 4, 2))).astype(np.float32)
    return recorded | {"action": action, "episode": np.arange(count) // 4}


def write_robot(folder: Path, discrete: bool = False) -> Path:
    """Write the folder of the honest policy.

    Args:
        folder: Made.
        discrete: Whether the actions are directions.
    """
    folder.mkdir(parents=True)
    output, chunk = (LABELS, "1") if discrete else (MOVES, "4")
    (folder / "policy.yaml").write_text(POLICY_YAML.replace("OUTPUT", output).replace("CHUNK", chunk))
    (folder / "policy.py").write_text(POLICY_PY.replace("DISCRETE = False", f"DISCRETE = {discrete}"))
    (folder / "environment.py").write_text(WORLD_PY)
    (folder / "vocabulary.json").write_text(json.dumps(VOCABULARY))
    (folder / "statistics.json").write_text(json.dumps(STATISTICS))
    world = module(folder / "environment.py")
    np.savez(folder / "calibration.npz", **demonstrations(world, 64, 1, discrete))
    np.savez(folder / "evaluation.npz", **demonstrations(world, 256, 2, discrete))
    write_weights(folder / "weights.safetensors")
    return folder


def write_weights(path: Path) -> None:
    """Write the weights that do what the expert does, put together by hand.

    The cameras' layers read the place of each target off its columns, the word switches one of them off, and the
    hidden layer cuts the way to the target into steps: clip(way, -r, r) = relu(way + r) - relu(way - r) - r.
    """
    import torch
    from safetensors.torch import save_file

    place = np.linspace(-1, 1, 8) / 190
    eye = np.zeros((2, 8, 8, 3))
    eye[0, :, :, 0] = eye[1, :, :, 2] = place * 255
    reach = 0.3 * np.arange(1, 5)
    near = eye * (1 + 0.01 * np.random.default_rng(1).normal(size=eye.shape))  # no two cameras are quite alike
    first, bias = np.zeros((16, 6)), np.zeros(16)
    moves, moved = np.zeros((4, 2, 16)), np.zeros((4, 2))
    for axis in range(2):
        for step, far in enumerate(reach):
            for sign in (0, 1):
                unit = 8 * axis + 2 * step + sign
                first[unit, [2 * axis, 2 * axis + 1, 4 + axis]] = 1, 1, -0.5
                bias[unit] = -far if sign else far
                moves[step, axis, unit] += 1 - 2 * sign
                moves[step + 1 : step + 2, axis, unit] -= 1 - 2 * sign
            moved[step, axis] = -0.3
    ways = np.stack([-moves.sum(0)[0], moves.sum(0)[0], -moves.sum(0)[1], moves.sum(0)[1]])
    turn = np.random.default_rng(0).permutation(16)
    words = np.zeros((8, 4))
    words[3], words[4] = (1, 0, 1, 0), (0, 1, 0, 1)
    layers = {
        "front": (eye.reshape(2, 192), np.zeros(2)), "wrist": (near.reshape(2, 192), np.zeros(2)),
        "first": (first, bias), "second": (np.eye(16)[turn], np.zeros(16)),
        "moves": ((moves.reshape(8, 16) / 0.2)[:, turn], moved.reshape(8) / 0.2),
        "directions": (3 * ways[:, turn], 3 * np.array([1.2, -1.2, 1.2, -1.2])),
    }  # fmt: skip
    arrays = {"words.weight": words}
    for name, (weight, shift) in layers.items():
        arrays |= {f"{name}.weight": weight, f"{name}.bias": shift}
    save_file({name: torch.tensor(value.tolist(), dtype=torch.float32) for name, value in arrays.items()}, str(path))
