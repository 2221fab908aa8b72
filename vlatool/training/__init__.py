"""One training loop for every stage that changes a policy's weights."""
