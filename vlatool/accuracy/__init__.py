"""How well a policy does: losses, success, pairs, and whether the reference can be trusted."""
