"""Somebody's checkpoint: a LeRobot Diffusion policy (DDIM, random weights), and what select_action() does."""

from pathlib import Path

import numpy as np
import torch
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from made import JOINTS, PIXELS, batch, features, keep

HERE = Path(__file__).parent
SIDE, HORIZON, STEPS = 96, 16, 8
RANGE = {"min": torch.linspace(-90, -30, JOINTS), "max": torch.linspace(30, 90, JOINTS)}
STATISTICS = {"observation.state": RANGE, "action": RANGE, "observation.images.front": PIXELS}


def config():
    sizes = {"down_dims": (64, 128, 256), "horizon": HORIZON, "n_action_steps": STEPS, "crop_shape": (84, 84)}
    sampling = {"noise_scheduler_type": "DDIM", "num_train_timesteps": 100, "num_inference_steps": 10}
    return DiffusionConfig(**features(SIDE, SIDE), device="cpu", **sizes, **sampling)


def chunk(policy, before, after, state, front, noise):
    """The chunk (8, 6) after two observations, as LeRobot's control loop takes it: calls of select_action()."""
    policy.reset()
    for joints, picture in zip(state, front, strict=True):
        seen = before(batch(joints, picture))
        policy._queues["action"].clear()
        first = policy.select_action(dict(seen), noise=torch.tensor(noise))
    actions = [first, *(policy.select_action(dict(seen)) for _ in range(STEPS - 1))]
    return np.stack([after(action)[0].numpy() for action in actions])


def recording(policy, before, after, seed, count):
    """Random joints and pictures at two moments, the noise, and the chunks that the policy gives."""
    random = np.random.default_rng(seed)
    state = random.uniform(-40, 40, size=(count, 2, JOINTS)).astype(np.float32)
    front = random.integers(0, 256, (count, 2, 6, 6, 3), np.uint8).repeat(16, axis=2).repeat(16, axis=3)
    noise = random.normal(size=(count, 1, HORIZON, JOINTS)).astype(np.float32)
    action = [chunk(policy, before, after, *row) for row in zip(state, front, noise, strict=True)]
    return {"state": state, "front": front, "action": np.array(action), "noise": noise}


if __name__ == "__main__":
    torch.manual_seed(0)
    keep(HERE, DiffusionPolicy(config()).eval(), STATISTICS, recording, noise="sample")
