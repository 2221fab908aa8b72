"""Somebody's checkpoint: a LeRobot ACT (random weights) with its processors, and what select_action() does."""

import functools
from pathlib import Path

import numpy as np
import torch
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from made import JOINTS, PIXELS, SPREAD, batch, features, keep

HERE = Path(__file__).parent
SIZE, CHUNK = (96, 128), 50
STATISTICS = {"observation.state": SPREAD, "action": SPREAD, "observation.images.front": PIXELS}


def config():
    sizes = {"chunk_size": CHUNK, "n_action_steps": CHUNK, "pretrained_backbone_weights": None, "device": "cpu"}
    return ACTConfig(**features(*SIZE), **sizes)


@functools.cache
def loaded():
    """The policy and its processors from the checkpoint."""
    policy = ACTPolicy.from_pretrained(HERE / "checkpoint").eval()
    return policy, *make_pre_post_processors(policy.config, pretrained_path=str(HERE / "checkpoint"))


def act(observation):
    """State (6,) in degrees and picture (96, 128, 3) uint8 to a chunk (50, 6) in degrees."""
    return chunk(*loaded(), observation["state"], observation["front"])


def chunk(policy, before, after, state, front):
    """One chunk (50, 6) as LeRobot's control loop takes it: 50 calls of select_action()."""
    seen = before(batch(state, front))
    policy.reset()
    return np.stack([after(policy.select_action(seen))[0].numpy() for _ in range(CHUNK)])


def recording(policy, before, after, seed, count):
    """Random joints and pictures, and the chunks that the policy gives."""
    random = np.random.default_rng(seed)
    state = random.normal(size=(count, JOINTS)).astype(np.float32) * np.linspace(5, 25, JOINTS, dtype=np.float32)
    coarse = random.integers(0, 256, (count, 6, 8, 3), np.uint8)
    front = coarse.repeat(16, axis=1).repeat(16, axis=2)
    action = [chunk(policy, before, after, *row) for row in zip(state, front, strict=True)]
    return {"state": state, "front": front, "action": np.array(action)}


if __name__ == "__main__":
    torch.manual_seed(0)
    keep(HERE, ACTPolicy(config()).eval(), STATISTICS, recording)
