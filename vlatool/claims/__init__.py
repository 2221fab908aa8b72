"""What a gate examines: one file for each claim, and what they share in ``_found`` and ``_timed``."""
