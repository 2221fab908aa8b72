"""A controller that infers at every control step and takes the first action of each chunk."""


class EveryStep:
    """Acts on the newest observation."""

    fresh = True

    def __init__(self, policy):
        self._policy = policy

    def act(self, observation):
        """Return the action of this control step: (A,) float32, or a 0-d int64 index."""
        return self._policy.infer(observation).chunk[0]

    def reset(self, seed=None):
        """Start a new episode."""
        self._policy.reset(seed)
