"""What somebody has: weights of a recurrent policy (random ones here), and what it does in recorded episodes."""

from pathlib import Path

import numpy as np
import torch
from network import Recurrent

HERE = Path(__file__).parent


def episodes(network, seed, count, length):
    """Drifting pictures and joints in episodes, and the velocities that the network gives from its state so far."""
    random, rows = np.random.default_rng(seed), {"image": [], "joints": [], "action": [], "episode": []}
    for episode in range(count):
        picture, joints, state = random.integers(0, 256, (96, 96, 3)), random.normal(size=7), torch.zeros(1, 1, 128)
        for _ in range(length):
            picture = np.clip(np.roll(picture, 3, axis=1) + random.integers(-20, 21, (96, 96, 3)), 0, 255)
            joints = joints + 0.2 * random.normal(size=7)
            seen = torch.tensor(picture, dtype=torch.float32).permute(2, 0, 1).unsqueeze(0) / 255
            with torch.no_grad():
                action, state = network(seen, torch.tensor(joints, dtype=torch.float32).unsqueeze(0), state)
            for name, value in zip(rows, (picture, joints, action.numpy(), episode), strict=True):
                rows[name].append(value)
    dtypes = {"image": np.uint8, "joints": np.float32, "action": np.float32, "episode": np.int64}
    return {name: np.array(values, dtypes[name]) for name, values in rows.items()}


if __name__ == "__main__":
    torch.manual_seed(0)
    network = Recurrent().eval()
    torch.save(network.state_dict(), HERE / "weights.pt")
    np.savez_compressed(HERE / "calibration.npz", **episodes(network, 1, 4, 16))
    np.savez_compressed(HERE / "evaluation.npz", **episodes(network, 2, 4, 16))
