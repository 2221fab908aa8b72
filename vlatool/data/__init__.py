"""Readers of calibration and evaluation data, one file per format."""

from __future__ import annotations

from vlatool.data._observations import observations_for, recorded_observations, synthetic_observations
from vlatool.data._recording import Recording, read_recording

__all__ = ["Recording", "observations_for", "read_recording", "recorded_observations", "synthetic_observations"]
