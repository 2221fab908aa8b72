import gymnasium
import numpy as np

MOVES = ((-4, 0), (4, 0), (0, -4), (0, 4))


class Dot(gymnasium.Env):
    """Bring the green square to the red one, four pixels a step."""

    observation_space = gymnasium.spaces.Box(0, 255, (84, 84, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.here, self.goal = self.np_random.integers(0, 80, 2), self.np_random.integers(0, 80, 2)
        self.steps = 0
        return self.picture(), {}

    def picture(self):
        picture = np.zeros((84, 84, 3), np.uint8)
        for place, channel in ((self.goal, 0), (self.here, 1)):
            picture[place[0] : place[0] + 5, place[1] : place[1] + 5, channel] = 255
        return picture

    def step(self, action):
        before = np.abs(self.here - self.goal).sum()
        self.here = np.clip(self.here + MOVES[int(action)], 0, 79)
        left = np.abs(self.here - self.goal).sum()
        self.steps += 1
        there = bool(left <= 8)
        return self.picture(), float(before - left), there, self.steps >= 60, {"is_success": there}


class Named(gymnasium.ObservationWrapper):
    """Observations by the names of policy.yaml."""

    def observation(self, observation):
        return {"image": observation}


def make(task, instruction="right"):
    return Named(Dot())
