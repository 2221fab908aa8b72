"""A wrapper of a policy whose actions move half as far."""


class Halved:
    """Infers what the policy does, and halves it."""

    def __init__(self, policy):
        self.spec, self._policy = policy.spec, policy

    def infer(self, observation, *, noise=None):
        """Return the next action chunk."""
        action = self._policy.infer(observation, noise=noise)
        return action._replace(chunk=action.chunk / 2)

    def reset(self, seed=None):
        """Start a new episode."""
        self._policy.reset(seed)
