"""Give a policy other weights, trained on what a teacher does."""
