"""Fixtures of latency models, which the tests of boards and of the latency model share."""

from _latency_models import certain, load, model, points, sample

__all__ = ["certain", "load", "model", "points", "sample"]
