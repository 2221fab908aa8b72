"""What the methods share that take ranges of activations from recorded observations."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.data import (
    PLAYED,
    Moment,
    Recording,
    calibration_checks,
    calibration_recording,
    observations_for,
    takes_not_finite,
)
from vlatool.errors import DataError
from vlatool.quantize._base import Quantization
from vlatool.quantize.calibration.activation_statistics import Values, calibrate
from vlatool.quantize.calibration.ranges import Statistics
from vlatool.quantize.calibration.samples import played_moments, recorded_moments
from vlatool.stage.base import Context, SampleSet

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

REPLACED = 16
"""Observations with NaN and infinity that calibrate, where an input takes them."""


class Calibrated(Quantization):
    """A method that needs calibration data."""

    without: ClassVar[str] = ""
    """What a user without calibration data can do instead."""

    calibration: Path | None = Field(None, description="recorded observations; the bundle's own when not given")
    samples: int = Field(64, ge=1, description="calibration samples, spread over the recording")

    def inputs(self) -> tuple[Path, ...]:
        """The calibration file."""
        return (self.calibration,) if self.calibration else ()

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """There is calibration data."""
        super().check(source, profile)
        if source is None or (PLAYED in source.manifest.files and not self.calibration):
            return
        if calibration_recording(source, self.calibration) is None:
            raise self._missing(source)

    def chosen(self, bundle: Bundle) -> tuple[Recording, list[int]]:
        """Return the recording and the numbers of the calibration samples; warn of what makes them unreliable.

        Args:
            bundle: Whose own recording is used when no other is given.

        Raises:
            DataError: when there is none.
        """
        recording = calibration_recording(bundle, self.calibration)
        if recording is None:
            raise self._missing(bundle)
        numbers = recording.spread(self.samples)
        asked = self.samples if self.samples != type(self).model_fields["samples"].default else 0
        for doubt in calibration_checks(recording, numbers, bundle.manifest.spec, bundle.path / "assets", asked):
            warnings.warn(doubt, stacklevel=3)
        return recording, numbers

    def statistics(
        self,
        bundle: Bundle,
        values: Values,
        seen: SampleSet,
        context: Context,
        spared: Mapping[str, Collection[str]] | None = None,
    ) -> dict[str, dict[str, Statistics]]:
        """Run the calibration samples, and what a training kept; return graph -> value -> statistics.

        Args:
            bundle, values, context, spared: As for ``calibrate``.
            seen: Takes the hash of each sample that goes by.

        Raises:
            DataError, GraphError: see ``calibrate``.
        """
        kept = not self.calibration and PLAYED in bundle.manifest.files
        if kept and calibration_recording(bundle) is None:
            return calibrate(bundle, values, played_moments(bundle, seen), context, spared=spared)
        recording, numbers = self.chosen(bundle)
        recorded = recorded_moments(bundle, recording, numbers, seen)
        played = (moment for _ in range(kept) for moment in played_moments(bundle, seen))  # after the others
        replaced = (Moment(each, 0, begins=True) for each in self._not_finite(bundle))
        moments = itertools.chain(recorded, played, replaced)
        return calibrate(bundle, values, moments, context, numbers=numbers, spared=spared)

    def _not_finite(self, bundle: Bundle) -> list[dict[str, Any]]:
        """Return observations with NaN and infinity where an input takes them: ranges hold what becomes of these."""
        return observations_for(bundle, REPLACED, self.calibration) if takes_not_finite(bundle.manifest.spec) else []

    def _missing(self, bundle: Bundle) -> DataError:
        plays = ", or quantize.qat, which plays episodes" if self.without and bundle.manifest.environment else ""
        fix = f"pass --calibration FILE.npz{self.without}{plays}"
        return DataError(f"{bundle.manifest.name} carries no calibration data, which {self.name()} needs.", fix)
