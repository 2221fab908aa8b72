"""Predictions for a policy on a board."""
