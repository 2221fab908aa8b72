"""How smooth the speed is, whatever its size and duration."""

from __future__ import annotations

import numpy as np

from vlatool.motion.metric import Metric
from vlatool.motion.track import Array, Track, lengths

MAX_HZ, MIN_AMPLITUDE, PADDING = 10.0, 0.05, 4


class SpectralArcLength(Metric):
    """Arc length of the normalised spectrum of the speed; 1.6 or so for one smooth reach, more for many small ones.

    SPARC of Balasubramanian, Melendez-Calderon, Roby-Brami and Burdet 2015 ("On the analysis of movement
    smoothness"), with the opposite sign, so that more is worse: the spectrum up to the last frequency, of at most
    10 Hz, with an amplitude of at least 5 % of the largest; the series is padded to 16 times the next power of two.
    """

    title = "spectral arc length"
    unit = ""

    def of(self, track: Track) -> float | None:
        """Return the length; None without positions and joints, and where nothing moves."""
        points = track.joints if track.position is None else track.position
        if points is None or len(points) < 4:
            return None
        speed = lengths(points) * track.hz
        return arc_length(speed, track.hz) if speed.any() else None


def arc_length(speed: Array, hz: float) -> float:
    """Return the arc length of the spectrum of a speed, (T,) sampled ``hz`` times a second, which is not all 0."""
    count = 2 ** (int(np.ceil(np.log2(len(speed)))) + PADDING)
    size = np.abs(np.fft.rfft(speed, count))
    frequency = np.fft.rfftfreq(count, 1 / hz)
    kept = frequency <= MAX_HZ
    size, frequency = size[kept] / size.max(), frequency[kept]
    last = int(np.flatnonzero(size >= MIN_AMPLITUDE)[-1]) + 1
    size, frequency = size[:last], frequency[:last]
    if last < 2:
        return 0.0
    across = np.diff(frequency) / (frequency[-1] - frequency[0])
    return float(np.sqrt(np.square(across) + np.square(np.diff(size))).sum())
