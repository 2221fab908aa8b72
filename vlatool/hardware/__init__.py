"""Boards and robots: hardware profiles and platforms."""
