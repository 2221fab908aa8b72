"""Claims of a gate: one file for each, found by its name."""
