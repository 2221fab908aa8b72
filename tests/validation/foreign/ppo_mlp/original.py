"""Somebody's training: PPO from Stable-Baselines3 on Pendulum-v1, and what its own predict() does."""

import functools
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import PPO

HERE = Path(__file__).parent


@functools.cache
def loaded():
    return PPO.load(HERE / "ppo.zip", device="cpu")


def act(observation):
    """State (3,) to torque (1, 1)."""
    action, _ = loaded().predict(observation["state"], deterministic=True)
    return np.asarray(action, np.float32).reshape(1, 1)


def states(model, seed, count):
    """States that the policy meets, a new episode after 50 steps, and its actions."""
    environment, met, did = gymnasium.make("Pendulum-v1"), [], []
    for step in range(count):
        if step % 50 == 0:
            state, _ = environment.reset(seed=seed + step)
        action, _ = model.predict(state, deterministic=True)
        met.append(state)
        did.append(action.reshape(1, 1))
        state, *_ = environment.step(action)
    return {"state": np.array(met, np.float32), "action": np.array(did, np.float32)}


if __name__ == "__main__":
    model = PPO("MlpPolicy", "Pendulum-v1", n_steps=512, seed=0, device="cpu").learn(2048)
    model.save(HERE / "ppo.zip")
    np.savez_compressed(HERE / "calibration.npz", **states(model, 1, 256))
    np.savez_compressed(HERE / "evaluation.npz", **states(model, 10_000, 100))
