"""Measurements of speed and memory; what is measured is what the robot runs."""
