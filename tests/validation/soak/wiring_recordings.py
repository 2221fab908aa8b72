"""Recordings of whole episodes, every control step, of five policies: what wirings are planted in.

    python tests/validation/soak/wiring_recordings.py --out FOLDER

Meta-World (``vla-metaworld``, ``vla-flow``) and GoToLocal (``vln-babyai``, ``vln-gru``) as the folders of the sample
policies simulate them, with the experts that taught these. The fifth, ``sawyer-joints``, is recorded as two arms are
that teach each other: the angles of the arm of Meta-World and its gripper, a camera in front and one at the wrist, and
as the action where the leading arm stands, ``LEAD`` control steps ahead of the other, measured with noise.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.verify._images import is_image

ROOT = Path(__file__).parents[3]
REFERENCE, ORDINARY = 4, 3
"""Episodes of each task in the reference, and of others; one each is disturbed."""
MAX_ROWS = 110
"""Control steps of an episode that are recorded."""
TASKS = ("button-press", "drawer-open", "drawer-close", "door-open", "window-open", "window-close", "faucet-open")
NEW_TASK = "faucet-close"
LEVELS = ("GoToLocalS6N3", "GoToLocalS8N4")
NEW_LEVEL = "GoToLocal"
LEAD, LEADER_NOISE = 3, 0.002
SEEDS = {"vla-metaworld": 0, "vla-flow": 1, "sawyer-joints": 2, "vln-babyai": 3, "vln-gru": 4}
Arrays = dict[str, np.ndarray]
Player = Callable[[str, int, str], Arrays]
"""Plays one episode of a task, with a seed and a kind of disturbance."""


def vector_inputs(spec: PolicySpec) -> list[str]:
    """Return the names of the inputs that are vectors of floats."""
    return [each.name for each in spec.inputs if each.kind != "text" and not is_image(each) and each.dtype == "float32"]


def image_inputs(spec: PolicySpec) -> list[str]:
    """Return the names of the inputs that are images."""
    return [each.name for each in spec.inputs if is_image(each)]


def record(policy: str, reference: int = REFERENCE, ordinary: int = ORDINARY) -> dict[str, list[Arrays]]:
    """Return episodes by what they are of: ``reference``, ``ordinary``, ``new task``, and each disturbance."""
    play, tasks, new_task, kinds = _player(policy)
    seeds = iter(range(10_000 * (1 + SEEDS[policy]), 10_000 * (2 + SEEDS[policy])))
    found: dict[str, list[Arrays]] = {
        "reference": [play(task, next(seeds), "") for task in tasks for _ in range(reference)],
        "ordinary": [play(task, next(seeds), "") for task in tasks for _ in range(ordinary)],
    }
    if ordinary == ORDINARY:
        found["new task"] = [play(new_task, next(seeds), "") for _ in tasks]
        found |= {kind: [play(task, next(seeds), kind) for task in tasks] for kind in kinds}
    return found


def _player(policy: str) -> tuple[Player, Sequence[str], str, Sequence[str]]:
    if policy.startswith("vln"):
        one_frame = policy == "vln-gru"
        kinds = ("start_pose", "light", "sensor_noise")
        return _of_babyai(one_frame), [level for level in LEVELS for _ in range(10)], NEW_LEVEL, kinds
    kinds = ("start_pose", "light", "sensor_noise", "camera_shift")
    return _of_metaworld(joints=policy == "sawyer-joints"), TASKS, NEW_TASK, kinds


def _of_metaworld(*, joints: bool) -> Player:
    os.environ.setdefault("LP_NUM_THREADS", "1")
    sys.path.insert(0, str(ROOT / "sample_models/vla-metaworld"))
    import environment
    from demonstrations import Expert, NoisyExpert

    made: dict[str, Any] = {}

    def play(task: str, seed: int, kind: str) -> Arrays:
        if task not in made:
            made[task] = environment.make(task), Expert(task)
        env, expert = made[task]
        env.disturb(kind or "light", 1.0 if kind else 0.0, seed)
        observation, info = env.reset(seed=seed)
        act = NoisyExpert(expert, np.random.default_rng([seed, 3]))
        rows: list[dict[str, Any]] = []
        ended = False
        while not ended and len(rows) < MAX_ROWS:
            action = act(env.simulation).astype(np.float32)
            row = {"image": observation["image"], "proprio": observation["proprio"], "action": action,
                   "instruction": observation["instruction"]}  # fmt: skip
            if joints:
                angles = np.append(info["joints"], observation["proprio"][3])
                row |= {"wrist": _wrist(env), "joints": angles.astype(np.float32)}
            rows.append(row)
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        return _as_taught(arrays, seed, kind) if joints else arrays

    return play


def _wrist(env: Any) -> np.ndarray:
    """Return what the camera at the gripper sees, uint8 (96, 96, 3)."""
    renderer = env._camera._renderer
    renderer.update_scene(env.simulation.data, "gripperPOV", env._camera._options)
    return np.array(renderer.render())


def _as_taught(arrays: Arrays, seed: int, kind: str) -> Arrays:
    random = np.random.default_rng([seed, 5])
    angles = arrays["joints"]
    if kind == "sensor_noise":
        angles = angles + random.normal(0, 0.005, angles.shape) * (np.arange(8) < 7)  # the gripper has none
    ahead = np.concatenate([arrays["joints"][LEAD:], np.repeat(arrays["joints"][-1:], LEAD, axis=0)])
    leader = ahead + random.normal(0, LEADER_NOISE, ahead.shape)
    return {"front": arrays["image"], "wrist": arrays["wrist"], "joints": angles.astype(np.float32),
            "action": leader.astype(np.float32), "instruction": arrays["instruction"]}  # fmt: skip


def _of_babyai(one_frame: bool) -> Player:
    sys.path.insert(0, str(ROOT / "sample_models/vln-babyai"))
    import environment
    from demonstrations import Recorder
    from rollout import Episode

    def play(task: str, seed: int, kind: str) -> Arrays:
        random = np.random.default_rng([seed, 3])
        env = environment.GoToLocal(task)
        env.disturb(kind or "light", 1.0 if kind else 0.0, seed)
        observation, _ = env.reset(seed=seed)
        recorder, episode = Recorder(), Episode(env, task, seed)
        rows: list[dict[str, Any]] = []
        ended = False
        while not ended:
            expert = recorder.expert_action(episode)
            action = int(random.integers(3)) if random.random() < 0.1 else expert
            rows.append({**observation, "action": action})
            observation, _, terminated, truncated, _ = env.step(action)
            episode.length += 1
            ended = terminated or truncated
        arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        if not one_frame:
            return arrays
        before = arrays.pop("actions")[:, -1:]
        return {**arrays, "image": arrays["image"][:, -1], "action_before": before}

    return play


def joined(episodes: Sequence[Arrays]) -> Arrays:
    """Return episodes as one recording, with their numbers."""
    whole = {name: np.concatenate([each[name] for each in episodes]) for name in episodes[0]}
    lengths = [len(each["action"]) for each in episodes]
    return {**whole, "episode": np.repeat(np.arange(len(episodes)), lengths)}


def recorded(policy: str, folder: Path) -> dict[str, list[Arrays]]:
    """Return the recordings of a policy, simulated once and kept in a folder."""
    if not (folder / policy).is_dir():
        for kind, episodes in record(policy).items():
            (folder / policy).mkdir(parents=True, exist_ok=True)
            np.savez(folder / policy / f"{kind}.npz", **joined(episodes))
    return {path.stem: _parted(dict(np.load(path))) for path in sorted((folder / policy).glob("*.npz"))}


def _parted(arrays: Arrays) -> list[Arrays]:
    numbers = arrays.pop("episode")
    return [{name: values[numbers == number] for name, values in arrays.items()} for number in np.unique(numbers)]


def main() -> None:
    """Simulate the recordings of all policies, or of those that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("policies", nargs="*", default=list(SEEDS))
    asked = parser.parse_args()
    for policy in asked.policies:
        found = recorded(policy, asked.out)
        rows = {
            kind: (len(episodes), sum(len(each["action"]) for each in episodes)) for kind, episodes in found.items()
        }
        print(policy, rows, flush=True)


if __name__ == "__main__":
    main()
