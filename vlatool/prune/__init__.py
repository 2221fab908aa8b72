"""Remove what a policy can do without, before it is exported."""
