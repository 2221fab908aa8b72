import gymnasium
import numpy as np


class Named(gymnasium.Wrapper):
    """Observations by the names of policy.yaml, and whether the episode succeeded."""

    def reset(self, **options):
        state, info = self.env.reset(**options)
        return {"state": state}, info

    def step(self, action):
        state, reward, terminated, truncated, info = self.env.step(np.asarray(action, np.float32))
        return {"state": state}, reward, terminated, truncated, {**info, "success": bool(state[0] > 0.9)}


def make(task, instruction="right"):
    return Named(gymnasium.make("Pendulum-v1"))
