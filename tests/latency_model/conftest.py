"""Fixtures of latency models, shared with tests of boards."""

from _latency_models import load, model, points, sample

__all__ = ["load", "model", "points", "sample"]
