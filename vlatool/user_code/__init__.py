"""A user's code: whose may run, and the child processes that run it."""
