"""User code: whose may run, and the child processes that run it."""
