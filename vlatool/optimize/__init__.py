"""The whole way from a policy to a chosen bundle."""
