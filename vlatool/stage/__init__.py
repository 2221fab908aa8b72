"""Stages: what they are, how they run, finish and are cached."""
