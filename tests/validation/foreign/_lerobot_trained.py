"""Record a dataset with LeRobot, and train an ACT policy on it; run in the Python that has LeRobot.

    python _lerobot_trained.py FOLDER [--steps 300]

Writes ``FOLDER/dataset`` (LeRobot v3, a camera as video) and ``FOLDER/checkpoint``, as ``lerobot-train`` saves one.
The demonstrator moves six joints towards the ball that the camera sees, a tenth of the way at each step.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

HZ, EPISODES, LENGTH, JOINTS, CHUNK = 10, 24, 30, 6, 8
HEIGHT, WIDTH = 64, 96
CAMERA = "observation.images.front"


def picture(ball, random):
    """Return a grey table with a red ball at ``ball`` (x, y from -1 to 1), (H, W, 3) uint8."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (ball[0] + 1) / 2 * WIDTH, (ball[1] + 1) / 2 * HEIGHT
    pixels = np.full((HEIGHT, WIDTH, 3), 90.0) + random.normal(0, 2, (HEIGHT, WIDTH, 3))
    pixels[(columns - x) ** 2 + (rows - y) ** 2 < 60] = (220, 40, 30)
    return np.clip(pixels, 0, 255).astype(np.uint8)


def record(folder):
    """Record the episodes, and return the dataset."""
    random = np.random.default_rng(0)
    names = [f"joint_{index}" for index in range(JOINTS)]
    vector = {"dtype": "float32", "shape": (JOINTS,), "names": names}
    camera = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    features = {CAMERA: camera, "observation.state": vector, "action": vector}
    dataset = LeRobotDataset.create("vlatool/ball", HZ, features, root=folder, use_videos=True)
    goal_of = random.normal(size=(2, JOINTS))
    for _ in range(EPISODES):
        ball, joints = random.uniform(-0.8, 0.8, 2), random.normal(0, 0.5, JOINTS)
        for _ in range(LENGTH):
            action = joints + 0.1 * (ball @ goal_of - joints)
            frame = {CAMERA: picture(ball, random), "observation.state": joints.astype(np.float32)}
            dataset.add_frame({**frame, "action": action.astype(np.float32), "task": "reach the ball"})
            joints = action + random.normal(0, 0.002, JOINTS)
        dataset.save_episode()
    dataset.finalize()


def train(folder, steps):
    """Train ACT on the dataset, and save the checkpoint."""
    torch.manual_seed(0)
    times = {"action": [step / HZ for step in range(CHUNK)]}
    dataset = LeRobotDataset("vlatool/ball", root=folder / "dataset", delta_timestamps=times, video_backend="pyav")
    shapes = {"observation.state": PolicyFeature(FeatureType.STATE, (JOINTS,))}
    shapes[CAMERA] = PolicyFeature(FeatureType.VISUAL, (3, HEIGHT, WIDTH))
    config = ACTConfig(
        input_features=shapes, output_features={"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))}, device="cpu",
        pretrained_backbone_weights=None, chunk_size=CHUNK, n_action_steps=CHUNK, dim_model=64, n_heads=4,
        dim_feedforward=128, n_encoder_layers=2, n_vae_encoder_layers=1, dropout=0.0,
    )  # fmt: skip
    policy = ACTPolicy(config)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    batches = torch.utils.data.DataLoader(dataset, batch_size=16, shuffle=True, drop_last=True)
    optimizer, step = torch.optim.AdamW(policy.parameters(), lr=5e-4), 0
    while step < steps:
        for batch in batches:
            loss, _ = policy.forward(before(batch))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            if step % 50 == 0 or step == steps:
                print(f"step {step}: loss {loss.item():.3f}", flush=True)
            if step == steps:
                break
    for part in (policy.eval(), before, after):
        part.save_pretrained(folder / "checkpoint")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    asked = parser.parse_args()
    record(asked.folder / "dataset")
    train(asked.folder, asked.steps)
