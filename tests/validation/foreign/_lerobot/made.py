"""What the checkpoints of LeRobot here have in common: an arm with a camera, and what is kept of it."""

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors

JOINTS = 6
PIXELS = {"mean": torch.tensor([0.485, 0.456, 0.406])[:, None, None], "std": torch.full((3, 1, 1), 0.225)}
SPREAD = {"mean": torch.linspace(-20, 30, JOINTS), "std": torch.linspace(5, 25, JOINTS)}
"""What LeRobot computes of a dataset: here of pictures and of made-up joints in degrees."""


def features(height, width):
    """What goes in and what comes out, as a configuration names it."""
    seen = {
        "observation.state": PolicyFeature(FeatureType.STATE, (JOINTS,)),
        "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, height, width)),
    }
    return {"input_features": seen, "output_features": {"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))}}


def batch(state, front, **others):
    """One observation as LeRobot's control loop takes it: picture (height, width, 3) uint8."""
    picture = torch.tensor(front).permute(2, 0, 1).float() / 255
    return {"observation.state": torch.tensor(state), "observation.images.front": picture, **others}


def keep(folder, policy, statistics, recording, noise=""):
    """Write checkpoint, recordings and, under a name, the noise that was drawn for the second.

    Args:
        folder: Where.
        policy: A policy of LeRobot.
        statistics: Of the dataset.
        recording: Policy, both processors, seed and count to arrays, with the noise beside the action.
        noise: How the program calls it; none is kept when empty.
    """
    before, after = make_pre_post_processors(policy.config, dataset_stats=statistics)
    for part in (policy, before, after):
        part.save_pretrained(folder / "checkpoint")
    for name, seed, count in (("calibration", 1, 32), ("evaluation", 2, 16)):
        arrays = recording(policy, before, after, seed, count)
        drawn = arrays.pop("noise", None)
        np.savez_compressed(folder / f"{name}.npz", **arrays)
    if noise:
        np.savez(folder / "noise.npz", **{noise: drawn})
