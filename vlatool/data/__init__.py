"""Readers of calibration and evaluation data, one file per format."""

from __future__ import annotations

from vlatool.data._calibration_checks import doubts
from vlatool.data._drawn import DRAWN, OTHER, RECORDED, Drawer, Drawn, read_drawn, save_drawn
from vlatool.data._halves import halves
from vlatool.data._observations import (
    CALIBRATION,
    EVALUATION,
    calibration_recording,
    evaluation_recording,
    observations_for,
    recorded_observations,
    synthetic_observations,
)
from vlatool.data._recording import Recording, read_recording

__all__ = [
    "CALIBRATION",
    "DRAWN",
    "EVALUATION",
    "OTHER",
    "RECORDED",
    "Drawer",
    "Drawn",
    "Recording",
    "calibration_recording",
    "doubts",
    "evaluation_recording",
    "halves",
    "observations_for",
    "read_drawn",
    "read_recording",
    "recorded_observations",
    "save_drawn",
    "synthetic_observations",
]
