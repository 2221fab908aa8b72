"""Base of the methods that take ranges of activations from recorded observations."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.data import (
    MAP_HELP,
    OBSERVATIONS_FILE,
    Moment,
    Recording,
    calibration_checks,
    calibration_recording,
    observations_for,
    takes_not_finite,
)
from vlatool.errors import DataError
from vlatool.quantize._base import Quantization
from vlatool.quantize.calibration.activation_statistics import ValueNames, calibrate
from vlatool.quantize.calibration.ranges import Statistics
from vlatool.quantize.calibration.samples import played_moments, recorded_moments
from vlatool.stage.base import Context
from vlatool.stage.record import SampleSet

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

NON_FINITE_SAMPLES = 16
"""Calibration observations with NaN and infinity, where an input takes them."""


class CalibratedQuantization(Quantization):
    """A method that needs calibration data."""

    alternative: ClassVar[str] = ""
    """What a user without calibration data can do instead."""

    calibration: Path | None = Field(None, description="recorded observations; the bundle's own when not given")
    map: tuple[str, ...] = Field((), description=MAP_HELP)
    samples: int = Field(64, ge=1, description="calibration samples, spread over the recording")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """There is calibration data."""
        super().check(source, profile)
        if source is None or (OBSERVATIONS_FILE in source.manifest.files and not self.calibration):
            return
        if calibration_recording(source, self.recording) is None:
            raise self._no_calibration_data(source)

    def calibration_samples(self, bundle: Bundle) -> tuple[Recording, list[int]]:
        """Return the recording and the indices of the calibration samples; warn of what makes them unreliable.

        Args:
            bundle: Bundle whose own recording is used when no other is given.
        """
        recording = calibration_recording(bundle, self.recording)
        if recording is None:
            raise self._no_calibration_data(bundle)
        numbers = recording.spread(self.samples)
        requested = self.samples if self.samples != type(self).model_fields["samples"].default else 0
        for warning in calibration_checks(recording, numbers, bundle.manifest.spec, bundle.path / "assets", requested):
            warnings.warn(warning, stacklevel=3)
        return recording, numbers

    def statistics(
        self, bundle: Bundle, values: ValueNames, samples: SampleSet, context: Context,
        exempt: Mapping[str, Collection[str]] | None = None
    ) -> dict[str, dict[str, Statistics]]:  # fmt: skip
        """Run the calibration samples, and observations saved by a training; return graph -> value -> statistics.

        Args:
            bundle, values, context, exempt: As for ``calibrate``.
            samples: Collector of the hash of each sample.
        """
        uses_played = not self.calibration and OBSERVATIONS_FILE in bundle.manifest.files
        if uses_played and calibration_recording(bundle) is None:
            return calibrate(bundle, values, played_moments(bundle, samples), context, exempt=exempt)
        recording, numbers = self.calibration_samples(bundle)
        recorded = recorded_moments(bundle, recording, numbers, samples)
        played = (moment for _ in range(uses_played) for moment in played_moments(bundle, samples))  # after the others
        non_finite: list[Moment] = []
        if takes_not_finite(bundle.manifest.spec):  # so that ranges cover what becomes of NaN and infinity
            observations = observations_for(bundle, NON_FINITE_SAMPLES, self.recording)
            non_finite = [Moment(each, 0, begins=True) for each in observations]
        moments = itertools.chain(recorded, played, non_finite)
        return calibrate(bundle, values, moments, context, numbers=numbers, exempt=exempt)

    def _no_calibration_data(self, bundle: Bundle) -> DataError:
        trainable = self.alternative and bundle.manifest.environment
        training = ", or quantize.qat, which plays episodes" if trainable else ""
        fix = f"pass --calibration FILE.npz{self.alternative}{training}"
        return DataError(f"{bundle.manifest.name} carries no calibration data, which {self.name()} needs.", fix)
