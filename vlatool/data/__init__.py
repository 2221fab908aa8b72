"""Readers of calibration and evaluation data, one file per format."""

from __future__ import annotations

from vlatool.data._doubts import doubts
from vlatool.data._observations import (
    calibration_recording,
    observations_for,
    recorded_observations,
    synthetic_observations,
)
from vlatool.data._recording import Recording, read_recording

__all__ = [
    "Recording",
    "calibration_recording",
    "doubts",
    "observations_for",
    "read_recording",
    "recorded_observations",
    "synthetic_observations",
]
