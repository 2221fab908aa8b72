"""Measurements of accuracy: against recorded actions, and in the closed loop of an environment."""
