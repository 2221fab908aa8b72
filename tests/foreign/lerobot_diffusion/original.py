"""Somebody's checkpoint: a LeRobot Diffusion policy (DDIM, random weights), and what select_action() does."""

from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors

HERE = Path(__file__).parent
JOINTS, SIDE, HORIZON, STEPS = 6, 96, 16, 8


def config():
    features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (JOINTS,)),
        "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))}
    sizes = {"down_dims": (64, 128, 256), "horizon": HORIZON, "n_action_steps": STEPS, "crop_shape": (84, 84)}
    sampling = {"noise_scheduler_type": "DDIM", "num_train_timesteps": 100, "num_inference_steps": 10}
    return DiffusionConfig(input_features=features, output_features=action, device="cpu", **sizes, **sampling)


def statistics():
    """What LeRobot computes of a dataset: here of made-up joints in degrees and of pictures."""
    joints = {"min": torch.linspace(-90, -30, JOINTS), "max": torch.linspace(30, 90, JOINTS)}
    picture = {"mean": torch.tensor([0.485, 0.456, 0.406])[:, None, None], "std": torch.full((3, 1, 1), 0.225)}
    return {"observation.state": joints, "action": dict(joints), "observation.images.front": picture}


def chunk(policy, before, after, state, front, noise):
    """The chunk (8, 6) after two observations, as LeRobot's control loop takes it: calls of select_action()."""
    policy.reset()
    for joints, picture in zip(state, front, strict=True):
        pixels = torch.tensor(picture).permute(2, 0, 1).float() / 255
        batch = before({"observation.state": torch.tensor(joints), "observation.images.front": pixels})
        policy._queues["action"].clear()
        first = policy.select_action(dict(batch), noise=torch.tensor(noise))
    actions = [first, *(policy.select_action(dict(batch)) for _ in range(STEPS - 1))]
    return np.stack([after(action)[0].numpy() for action in actions])


def recording(policy, before, after, seed, count):
    """Random joints and pictures at two moments, the noise, and the chunks that the policy gives."""
    random = np.random.default_rng(seed)
    state = random.uniform(-40, 40, size=(count, 2, JOINTS)).astype(np.float32)
    front = random.integers(0, 256, (count, 2, 6, 6, 3), np.uint8).repeat(16, axis=2).repeat(16, axis=3)
    noise = random.normal(size=(count, 1, HORIZON, JOINTS)).astype(np.float32)
    action = [chunk(policy, before, after, *row) for row in zip(state, front, noise, strict=True)]
    return {"state": state, "front": front, "action": np.array(action)}, noise


if __name__ == "__main__":
    torch.manual_seed(0)
    policy = DiffusionPolicy(config()).eval()
    before, after = make_pre_post_processors(policy.config, dataset_stats=statistics())
    for part in (policy, before, after):
        part.save_pretrained(HERE / "checkpoint")
    calibration, _ = recording(policy, before, after, 1, 32)
    evaluation, noise = recording(policy, before, after, 2, 16)
    np.savez_compressed(HERE / "calibration.npz", **calibration)
    np.savez_compressed(HERE / "evaluation.npz", **evaluation)
    np.savez(HERE / "noise.npz", sample=noise)
