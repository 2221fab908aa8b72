"""What a gate examines: one file for each claim, found by its name."""
