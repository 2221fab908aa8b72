"""Measure accuracy, on recordings or in the closed loop."""
