"""Somebody's checkpoint: a LeRobot Diffusion policy (DDIM, random weights), and what select_action() does."""

from pathlib import Path

import numpy as np
import torch
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from made import JOINTS, PIXELS, batch, features, keep

HERE = Path(__file__).parent
SIDE, HORIZON, STEPS = 96, 16, 8
LENGTH, PLAYED = 8, 60
"""Control steps of a recorded episode, and of one that is played."""
RANGE = {"min": torch.linspace(-90, -30, JOINTS), "max": torch.linspace(30, 90, JOINTS)}
STATISTICS = {"observation.state": RANGE, "action": RANGE, "observation.images.front": PIXELS}


def config():
    sizes = {"down_dims": (64, 128, 256), "horizon": HORIZON, "n_action_steps": STEPS, "crop_shape": (84, 84)}
    sampling = {"noise_scheduler_type": "DDIM", "num_train_timesteps": 100, "num_inference_steps": 10}
    network = {"pretrained_backbone_weights": None, "use_group_norm": True}
    return DiffusionConfig(**features(SIDE, SIDE), device="cpu", **sizes, **sampling, **network)


def seen(count, random):
    """What an arm sees along an episode: joints, pictures, and the noise of each control step."""
    state = np.clip(np.cumsum(random.uniform(-9, 9, (count, JOINTS)), axis=0), -40, 40).astype(np.float32)
    front = random.integers(0, 256, (count, 6, 6, 3), np.uint8).repeat(16, axis=1).repeat(16, axis=2)
    noise = random.normal(size=(count, 1, HORIZON, JOINTS)).astype(np.float32)
    return {"state": state, "front": front, "noise": noise}


def action(policy, before, after, state, front, noise):
    """The action (6,) of the next control step."""
    return after(policy.select_action(before(batch(state, front)), noise=torch.tensor(noise)))[0].numpy()


def chunk(policy, before, after, *step):
    """The chunk (8, 6) of the next control step, whatever is left of the last one."""
    policy._queues["action"].clear()
    first = action(policy, before, after, *step)
    return np.stack([first, *(after(each)[0].numpy() for each in policy._queues["action"])])


def recording(policy, before, after, seed, count):
    """Episodes with the chunk that the policy gives at each control step: it has seen the one before."""
    random = np.random.default_rng(seed)
    episode, rows, chunks = np.arange(count) // LENGTH, seen(count, random), []
    for number in range(count):
        if number % LENGTH == 0:
            policy.reset()
        chunks.append(chunk(policy, before, after, *(values[number] for values in rows.values())))
    return {**rows, "episode": episode, "action": np.array(chunks)}


def played(policy, before, after):
    """Control steps of an episode, and the action of each: an inference at one in eight."""
    policy.reset()
    rows = seen(PLAYED, np.random.default_rng(3))
    actions = [action(policy, before, after, *row) for row in zip(*rows.values(), strict=True)]
    return {**rows, "action": np.stack(actions)}


if __name__ == "__main__":
    torch.manual_seed(0)
    policy = DiffusionPolicy(config()).eval()
    keep(HERE, policy, STATISTICS, recording, noise="sample")
    processors = make_pre_post_processors(policy.config, dataset_stats=STATISTICS)
    np.savez_compressed(HERE / "played.npz", **played(policy, *processors))
