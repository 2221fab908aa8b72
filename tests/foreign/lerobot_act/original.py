"""Somebody's checkpoint: a LeRobot ACT (random weights) with its processors, and what select_action() does."""

import functools
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

HERE = Path(__file__).parent
JOINTS, SIZE, CHUNK = 6, (96, 128), 50


def config():
    features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (JOINTS,)),
        "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, *SIZE)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))}
    sizes = {"chunk_size": CHUNK, "n_action_steps": CHUNK, "pretrained_backbone_weights": None, "device": "cpu"}
    return ACTConfig(input_features=features, output_features=action, **sizes)


def statistics():
    """What LeRobot computes of a dataset: here of made-up joints in degrees and of pictures."""
    joints = {"mean": torch.linspace(-20, 30, JOINTS), "std": torch.linspace(5, 25, JOINTS)}
    picture = {"mean": torch.tensor([0.485, 0.456, 0.406])[:, None, None], "std": torch.full((3, 1, 1), 0.225)}
    return {"observation.state": joints, "action": dict(joints), "observation.images.front": picture}


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
    picture = torch.tensor(front).permute(2, 0, 1).float() / 255
    batch = before({"observation.state": torch.tensor(state), "observation.images.front": picture})
    policy.reset()
    return np.stack([after(policy.select_action(batch))[0].numpy() for _ in range(CHUNK)])


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
    policy = ACTPolicy(config()).eval()
    before, after = make_pre_post_processors(policy.config, dataset_stats=statistics())
    for part in (policy, before, after):
        part.save_pretrained(HERE / "checkpoint")
    np.savez_compressed(HERE / "calibration.npz", **recording(policy, before, after, 1, 32))
    np.savez_compressed(HERE / "evaluation.npz", **recording(policy, before, after, 2, 16))
