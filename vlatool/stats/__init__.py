"""Intervals, bounds and tests on measurements."""
