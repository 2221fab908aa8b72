"""Inputs with clocks of their own: buffers of samples, brought to one time, and refused when they are too old.

A sample has up to two times: its arrival, by the monotonic clock of this process, and the stamp of the sensor's own
clock. All ages are counted on the monotonic clock. A stamp only says how much longer a sample took than the fastest one
so far: stamps may step by an hour, repeat or come in another order. After a step, samples are dropped until the stamps
have agreed with the arrivals for a while. What stamps cannot show is a delay that all samples have (``latency_s``), and
a clock that is set back by less than a minute: its samples count as late from then on (``clear(clock=True)``).
"""

from __future__ import annotations

import copy
import math
import numbers
import time
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vlatool.bundle.conversion import ROTATIONS
from vlatool.errors import DataError, UsageError
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.interface import Array
from vlatool.runtime.rotation import convert_rotation, slerp, to_quaternions

NEAREST, LINEAR = "nearest", "linear"
DRIFT = 2e-4
"""Largest rate by which a sensor's clock may lose time: four times the 50 ppm of a cheap quartz."""
STEP_S = 60.0
"""A sample whose stamp says that it took longer than this was not late: the sensor's clock was set."""
SPREAD = 0.25
"""Share of ``stale_s`` by which offsets of stamps may differ while they settle, and fall at once later on."""


@dataclass(frozen=True)
class SensorLimits:
    """What is asked of the samples of a sensor.

    Args:
        stale_s: Largest age of a sample that is used, in seconds.
        noisy: Whether two measurements are never the same bit by bit, as of a camera: a repeated value then is the
            same measurement, whatever its stamp says.
        latency_s: Least time from the measurement to the arrival, which is added to all ages.
        method: ``nearest``, ``linear``, or a form of ``ROTATIONS``, such as ``quaternion_xyzw``, which turns along the
            shortest arc: what lies between two samples.
        settle_s: Time for which stamps have to agree with the arrivals before they count, at first and after a step.
        capacity: Samples that are kept.

    Raises:
        UsageError: when a number is out of its range or the method is unknown.
    """

    stale_s: float
    noisy: bool = False
    latency_s: float = 0.0
    method: str = NEAREST
    settle_s: float = 1.0
    capacity: int = 64

    def __post_init__(self) -> None:
        check_positive("stale_s", self.stale_s, "a number of seconds")
        check_positive("latency_s", self.latency_s, "a number of seconds", zero=True)
        check_positive("settle_s", self.settle_s, "a number of seconds", zero=True)
        check_whole("capacity", self.capacity, 2)
        _check_method(self.method, (NEAREST, LINEAR, *ROTATIONS))


class Sample(NamedTuple):
    """A value of a sensor at a time of the monotonic clock.

    Args:
        value: As the policy takes it.
        time: When it was measured, at the latest the time of its arrival; of a value between two samples, that time.
        oldest: The earlier measurement of the two that it lies between.
    """

    value: Any
    time: float
    oldest: float


class SensorBuffer:
    """The last samples of one sensor.

    Args:
        clock: Monotonic time in seconds.
    """

    def __init__(self, limits: SensorLimits, clock: Callable[[], float] = time.monotonic) -> None:
        self.limits = limits
        self.dropped = 0
        """Samples that were not kept: repeated, older than all that are, of a clock that settles, without a time."""
        self._clock = clock
        self._offset = _Offset(limits.stale_s, limits.settle_s)
        self._times: list[float] = []
        self._values: list[Any] = []
        self._seen: dict[int, float] = {}

    def add(self, value: Any, stamp: float | None = None, arrival: float | None = None) -> bool:
        """Keep a copy of a sample; return whether it is kept.

        Args:
            stamp: Time of the measurement by the sensor's own clock, in seconds; the arrival counts when None.
            arrival: When it came, by the monotonic clock; now when None.

        Raises:
            UsageError: when a time is not a number.
        """
        arrival = self._clock() if arrival is None else arrival
        moment, value = self._measured(stamp, arrival), _copied(value)
        first = self._first_seen(value, arrival if moment is None else moment)
        moment = None if moment is None else first
        full = len(self._times) == self.limits.capacity
        if moment is None or moment in self._times or (full and moment < self._times[0]):
            self.dropped += 1
            return False
        index = bisect_right(self._times, moment)
        self._times.insert(index, moment)
        self._values.insert(index, value)
        del self._times[: -self.limits.capacity], self._values[: -self.limits.capacity]
        return True

    def _measured(self, stamp: float | None, arrival: float) -> float | None:
        """Return when a sample was measured, by the monotonic clock; None where nobody knows."""
        for name, value in (("stamp", stamp), ("arrival", arrival)):
            if value is not None and not isinstance(value, numbers.Real):
                raise UsageError(f"{name} is {value!r:.80}; allowed: a number of seconds.", "convert it to float")
        if not math.isfinite(arrival) or (stamp is not None and not math.isfinite(stamp)):
            return None
        late = 0.0 if stamp is None else self._offset.lateness(stamp, arrival)
        return None if late is None else arrival - late - self.limits.latency_s

    def _first_seen(self, value: Any, moment: float) -> float:
        """Return the time of a sample; that of an earlier one, kept or not, where it only repeats that."""
        if not self.limits.noisy or not math.isfinite(moment):
            return moment
        content = _checksum(value)
        moment = min(moment, self._seen.pop(content, moment))
        self._seen[content] = moment
        if len(self._seen) > self.limits.capacity:
            del self._seen[next(iter(self._seen))]
        return moment

    def at(self, moment: float) -> Sample | None:
        """Return the value at a time of the monotonic clock, None without samples; beyond the ends, the sample there.

        With ``nearest``, the later of two samples that are equally near.

        Raises:
            DataError: when the method is another one, and the samples are not numbers of one shape that it takes.
        """
        if not self._times:
            return None
        after = bisect_left(self._times, moment)
        last = max(0, bisect_right(self._times, self._clock()) - 1)  # what is still to come stands for nothing now
        if after > last or after == 0 or self._times[after] == moment:
            return self._sample(min(after, last))
        before, share = after - 1, (moment - self._times[after - 1]) / (self._times[after] - self._times[after - 1])
        if self.limits.method == NEAREST:
            return self._sample(after if share >= 0.5 else before)
        value = _between(self._values[before], self._values[after], share, self.limits.method)
        return Sample(value, moment, self._times[before])

    def _sample(self, index: int) -> Sample:
        return Sample(self._values[index], self._times[index], self._times[index])

    def copy(self, clock: Callable[[], float]) -> SensorBuffer:
        """Return a buffer with the same samples, which goes its own way from now on, by a clock of its own."""
        other = SensorBuffer(self.limits, clock)
        other.dropped, other._offset = self.dropped, self._offset.copy()
        other._times, other._values, other._seen = [*self._times], [*self._values], dict(self._seen)
        return other

    @property
    def newest(self) -> float | None:
        """When the newest sample was measured, by the monotonic clock; None without samples."""
        return self._times[-1] if self._times else None

    def clear(self, *, clock: bool = False) -> None:
        """Forget all samples, and with ``clock`` what is known of the sensor's clock."""
        self._times, self._values = [], []
        if clock:
            self._offset = _Offset(self.limits.stale_s, self.limits.settle_s)


class _Offset:
    """How much later than the fastest one so far samples arrive, from stamps of a clock that may drift and be set.

    Args:
        stale_s: Longest gap between arrivals while offsets settle; a share ``SPREAD`` of it is transport.
        settle_s: Time for which offsets have to be no farther apart than transport makes them before one counts.
    """

    def __init__(self, stale_s: float, settle_s: float) -> None:
        self._gap_s, self._spread, self._settle_s = stale_s, stale_s * SPREAD, settle_s
        self._least: float | None = None
        self._at = 0.0
        self._settling: list[tuple[float, float]] = []

    def copy(self) -> _Offset:
        """Return the same, which goes its own way from now on."""
        other = _Offset(self._gap_s, self._settle_s)
        vars(other).update({**vars(self), "_settling": [*self._settling]})
        return other

    def lateness(self, stamp: float, arrival: float) -> float | None:
        """Return the seconds that a sample took longer than the fastest; None while the clock settles."""
        offset = arrival - stamp
        if self._least is None:
            return self._settled(offset, arrival)
        allowed = self._least + DRIFT * max(0.0, arrival - self._at)
        if not -self._spread <= offset - allowed <= STEP_S:
            return self._settled(offset, arrival)
        self._settling = []
        self._least, self._at = min(allowed, offset), arrival
        return offset - self._least

    def _settled(self, offset: float, arrival: float) -> float | None:
        """Return how late a sample is when offsets have agreed for long enough; they are those of the clock then."""
        known = [each for each, _ in self._settling]
        gap = arrival - self._settling[-1][1] if self._settling else 0.0
        if max([offset, *known]) - min([offset, *known]) > self._spread or gap > self._gap_s:
            self._settling = []
        self._settling.append((offset, arrival))
        if arrival - self._settling[0][1] < self._settle_s:
            return None
        self._least, self._at = min(each for each, _ in self._settling), arrival
        self._settling = []
        return offset - self._least


class Reading(NamedTuple):
    """What all sensors say at one time.

    Args:
        observation: Name -> value.
        time: The common time, by the monotonic clock.
        ages_s: Name -> age of the (earlier) sample, in seconds.
        skew_s: Largest difference between the times of two values.
        problems: Sentences on what is missing, stale or too far apart; empty when the observation may be used.
    """

    observation: Mapping[str, Any]
    time: float
    ages_s: Mapping[str, float]
    skew_s: float
    problems: tuple[str, ...]


class Sensors:
    """The buffers of all sensors of a policy, read at one time.

    Args:
        limits: Name of the input -> limits of its sensor.
        skew_s: Largest difference between the times of two values, in seconds; not checked when None.
        clock: Monotonic time in seconds.

    Raises:
        UsageError: when no sensor is named, or a number is out of its range.
    """

    def __init__(
        self, limits: Mapping[str, SensorLimits], skew_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        check_positive("skew_s", skew_s, "a number of seconds", optional=True)
        if not limits:
            raise UsageError("No sensor is named.", "name one for each input")
        if not isinstance(limits, Mapping) or not all(isinstance(each, SensorLimits) for each in limits.values()):
            raise UsageError(f"limits is {limits!r:.80}; allowed: the SensorLimits of each input, by name.",
                             'pass {"state": SensorLimits(stale_s=0.1)}')  # fmt: skip
        self.buffers = {name: SensorBuffer(each, clock) for name, each in limits.items()}
        self._skew_s, self._clock = skew_s, clock

    def copy(self, clock: Callable[[], float]) -> Sensors:
        """Return buffers with the same samples, which go their own way from now on, by a clock of their own."""
        other = copy.copy(self)
        other.buffers, other._clock = {name: each.copy(clock) for name, each in self.buffers.items()}, clock
        return other

    def add(self, name: str, value: Any, stamp: float | None = None, arrival: float | None = None) -> bool:
        """Keep a sample of a sensor; see ``SensorBuffer.add``.

        Raises:
            UsageError: when there is no sensor of this name.
        """
        if name not in self.buffers:
            raise UsageError.unknown(f"There is no sensor '{name}'", name, sorted(self.buffers))
        return self.buffers[name].add(value, stamp, arrival)

    def read(self) -> Reading:
        """Return the values at the newest time for which every sensor has a sample, with what is wrong with them.

        Raises:
            DataError: when nothing lies between two samples of a sensor that is not of the method ``nearest``.
        """
        now = self._clock()
        newest = [buffer.newest for buffer in self.buffers.values() if buffer.newest is not None]
        moment = min([now, *newest])
        samples = {name: buffer.at(moment) for name, buffer in self.buffers.items()}
        there = {name: sample for name, sample in samples.items() if sample is not None}
        ages = {name: now - sample.oldest for name, sample in there.items()}
        times = [sample.time for sample in there.values()]
        skew = max(times, default=0.0) - min(times, default=0.0)
        problems = [*(self._missing(name) for name in samples if name not in there), *self._stale(ages)]
        if self._skew_s is not None and skew > self._skew_s:
            problems.append(f"the values are {skew:.3g} s apart; allowed: {self._skew_s:g} s")
        return Reading({name: each.value for name, each in there.items()}, moment, ages, skew, tuple(problems))

    def _missing(self, name: str) -> str:
        dropped = self.buffers[name].dropped
        return f"'{name}' has no sample" + (f" that counts yet; dropped: {dropped}" if dropped else "")

    def _stale(self, ages: Mapping[str, float]) -> list[str]:
        limits = {name: buffer.limits.stale_s for name, buffer in self.buffers.items()}
        return [f"'{name}' is {age:.3g} s old; allowed: {limits[name]:g} s"
                for name, age in ages.items() if not 0 <= age <= limits[name]]  # fmt: skip

    def observation(self) -> Mapping[str, Any]:
        """Return the values at the newest common time.

        Raises:
            DataError: when one is missing or stale, or they are too far apart.
        """
        reading = self.read()
        if reading.problems:
            raise DataError(f"The sensors give no observation: {'; '.join(reading.problems)}.",
                            "see whether each sensor still sends; a fallback answers this step")  # fmt: skip
        return reading.observation

    def clear(self) -> None:
        """Forget all samples, as at the start of an episode."""
        for buffer in self.buffers.values():
            buffer.clear()


def fuse(samples: Sequence[tuple[Any, float, float]], half_life_s: float, method: str = LINEAR) -> Array:
    """Return the mean of what several sensors say of one quantity, with weights trust * 2^(-age / half_life_s).

    Args:
        samples: (value, age in s, trust) of each sensor: arrays of one shape; ages from 0; trusts from 0, not all 0.
        half_life_s: Age at which a value counts half as much.
        method: ``linear``, or a form of ``ROTATIONS``, whose mean is taken along shortest arcs, in order.

    Raises:
        DataError: when there is nothing to fuse: no sample, no trust, or a value that is not finite; or values of
            several shapes.
        UsageError: when the method is unknown.
    """
    _check_method(method, (LINEAR, *ROTATIONS))
    check_positive("half_life_s", half_life_s, "a number of seconds")
    weights = [trust * 2.0 ** (-max(0.0, age) / half_life_s) for _, age, trust in samples]
    values = [np.asarray(value, np.float64) for value, _, _ in samples]
    numbers = [*weights, *(age for _, age, _ in samples)]
    known = all(np.isfinite(value).all() for value in values) and all(map(math.isfinite, numbers))
    if not known or min(weights, default=0.0) < 0 or sum(weights) <= 0:
        raise DataError("No sensor has a finite value and trust above 0.", "leave sensors out that say nothing")
    mean, total = values[0], weights[0]
    for value, weight in zip(values[1:], weights[1:], strict=True):
        total += weight
        mean = mean if weight == 0 else _between(mean, value, weight / total, method)
    return mean


def _check_method(method: str, known: Sequence[str]) -> None:
    if method not in known:
        raise UsageError.unknown(f"There is no method '{method}'", method, known)


def _between(before: Any, after: Any, share: float, method: str) -> Array:
    """Return the value at a share of the way between two; raises DataError where nothing lies between them."""
    one, other = _numbers(before, method), _numbers(after, method)
    if one.shape != other.shape:
        raise DataError(f"Two values of a sensor have the shapes {one.shape} and {other.shape}.",
                        "give samples of one shape")  # fmt: skip
    if method == LINEAR:
        return np.asarray(one + (other - one) * share, one.dtype)
    turned = slerp(to_quaternions(one, method), to_quaternions(other, method), share)
    return convert_rotation(turned, "quaternion_xyzw", method, "keep").astype(one.dtype)


def _numbers(value: Any, method: str) -> Array:
    """Return a value as an array of floats, so that differences of unsigned integers do not wrap around."""
    array = np.asarray(value)
    wanted = ROTATIONS.get(method)
    if array.dtype.kind not in "iuf" or (wanted and array.shape[-1:] != (wanted,)):
        elements = f"{wanted} numbers" if wanted else "numbers"
        raise DataError(f"Between samples of {array.dtype} {array.shape} the method '{method}' knows no value; it "
                        f"takes {elements}.", "use the method 'nearest', or the one of such values")  # fmt: skip
    return array.astype(np.result_type(array, np.float32))


def _copied(value: Any) -> Any:
    return value if isinstance(value, str) else np.array(value)


def _checksum(value: Any) -> int:
    """Return a number for a content; that two contents share one makes a sample older, and none younger."""
    return zlib.crc32(value.encode() if isinstance(value, str) else np.ascontiguousarray(value).tobytes())
