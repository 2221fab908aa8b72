"""Policies that cheat, stall or fail, around one that is real."""

import time

import numpy as np


class Wrapped:
    """A policy that is asked through another one."""

    def __init__(self, policy):
        self._policy = policy
        self.calls = 0

    def __getattr__(self, name):
        return getattr(self._policy, name)

    def infer(self, observation, **more):
        self.calls += 1
        return self._policy.infer(observation, **more)


class Memoising(Wrapped):
    """Answers an observation that it has seen from memory."""

    def __init__(self, policy):
        super().__init__(policy)
        self._known = {}

    def infer(self, observation, **more):
        key = b"".join(np.asarray(observation[name]).tobytes() for name in sorted(observation))
        if key not in self._known:
            self._known[key] = super().infer(observation, **more)
        return self._known[key]


class Garbage(Wrapped):
    """Returns another action than it should once it is called often."""

    def __init__(self, policy, after):
        super().__init__(policy)
        self._after = after

    def infer(self, observation, **more):
        action = super().infer(observation, **more)
        if self.calls <= self._after:
            return action
        return action._replace(outputs={name: value + 1 for name, value in action.outputs.items()})


class Stalling(Wrapped):
    """Stalls in every so many calls."""

    def __init__(self, policy, every=1000, seconds=0.05, sleep=time.sleep):
        super().__init__(policy)
        self._every, self._seconds, self._sleep = every, seconds, sleep

    def infer(self, observation, **more):
        action = super().infer(observation, **more)
        if self.calls % self._every == 0:
            self._sleep(self._seconds)
        return action


class Drawing(Wrapped):
    """Adds noise that starts over with every reset."""

    def reset(self):
        self._policy.reset()
        self._random = np.random.default_rng(0)

    def infer(self, observation, **more):
        action = super().infer(observation, **more)
        return action._replace(
            outputs={name: value + self._random.normal(size=value.shape) for name, value in action.outputs.items()}
        )
