"""Train the weights of a policy to do what a teacher does."""
