"""Somebody's training: PPO from Stable-Baselines3 on pictures, and what its own predict() does on recorded ones."""

import functools
from pathlib import Path

import numpy as np
from environment import Dot
from stable_baselines3 import PPO

HERE = Path(__file__).parent


@functools.cache
def loaded():
    return PPO.load(HERE / "ppo.zip", device="cpu")


def act(observation):
    """Picture (84, 84, 3) uint8 to the index of a move (1,)."""
    action, _ = loaded().predict(observation["image"], deterministic=True)
    return np.asarray(action).reshape(1)


def pictures(model, seed, count):
    """Pictures that chance leads to, and the policy's actions on them."""
    environment, random, met, did = Dot(), np.random.default_rng(seed), [], []
    for step in range(count):
        if step % 20 == 0:
            picture, _ = environment.reset(seed=seed + step)
        action, _ = model.predict(picture, deterministic=True)
        met.append(picture)
        did.append(np.asarray(action).reshape(1))
        picture, *_ = environment.step(int(random.integers(4)))
    return {"image": np.array(met), "action": np.array(did, np.int64)}


if __name__ == "__main__":
    model = PPO("CnnPolicy", Dot(), n_steps=128, n_epochs=4, seed=0, device="cpu").learn(512)
    model.save(HERE / "ppo.zip")
    np.savez_compressed(HERE / "calibration.npz", **pictures(model, 1, 64))
    np.savez_compressed(HERE / "evaluation.npz", **pictures(model, 10_000, 64))
