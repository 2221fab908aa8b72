"""Summary of samples: gauges, differences of counters, energy, throttling; pure functions."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from vlatool.telemetry._reading import JOULE, THROTTLE, WATT, Absent, Reading
from vlatool.telemetry._total import Total, totals

NO_POWER = (
    "no reading is known to be the power of the board, so energy is unmeasured; "
    "check the power readers, or measure at the supply"
)


@dataclass
class Series:
    """All samples of one reading, in the order of time: 16 bytes each.

    Args:
        first: The first reading; name, unit, kind and wrap-around are the same for all.
        times: Seconds.
        values: Values in the unit of ``first``.
        notes: The different notes, in the order in which they came.
    """

    first: Reading
    times: array[float] = field(default_factory=lambda: array("d"))
    values: array[float] = field(default_factory=lambda: array("d"))
    notes: list[str] = field(default_factory=list)

    def append(self, time_s: float, reading: Reading) -> None:
        """Add one sample."""
        self.times.append(time_s)
        self.values.append(reading.value)
        if reading.note and reading.note not in self.notes:
            self.notes.append(reading.note)

    @property
    def note(self) -> str:
        """The notes, as one text."""
        return ", then ".join(self.notes)


@dataclass(frozen=True)
class Gauge:
    """A gauge over the run, in ``unit``; ``mean`` is that of the samples, ``times`` are in seconds."""

    unit: str
    min: float
    mean: float
    max: float
    times: tuple[float, ...]
    values: tuple[float, ...]
    note: str


@dataclass(frozen=True)
class Change:
    """Change of a counter, in ``unit``, during ``seconds``."""

    unit: str
    difference: float
    seconds: float
    note: str


@dataclass(frozen=True)
class Energy:
    """Energy over the run.

    Args:
        joules: Energy from the first to the last sample.
        mean_w: The same over ``seconds``.
        seconds: Time between the first and the last sample.
        label: Description of the consumer, with exclusions.
        source: ``counter`` or ``power samples`` (trapezoid rule).
    """

    joules: float
    mean_w: float
    seconds: float
    label: str
    source: str
    names: tuple[str, ...]
    samples: int


@dataclass(frozen=True)
class Summary:
    """Telemetry of a run.

    Args:
        seconds: Time between the first and the last sample.
        energy: Energy of the board or its processor, then of the graphics cards, where measured; they are not added,
            and have labels. Empty when unmeasured.
        throttled: Whether a throttle counter moved or a throttle bit was set; None when unknown.
        throttling: Descriptions of what throttled.
        unmeasured: What could not be measured, and why.
    """

    seconds: float
    energy: tuple[Energy, ...]
    throttled: bool | None
    throttling: tuple[str, ...]
    gauges: Mapping[str, Gauge]
    counters: Mapping[str, Change]
    unmeasured: tuple[Absent, ...]


def collect(samples: Iterable[tuple[float, Reading]]) -> dict[str, Series]:
    """Return the series of samples that are in the order of time (seconds)."""
    series: dict[str, Series] = {}
    for time_s, reading in samples:
        series.setdefault(reading.name, Series(reading)).append(time_s, reading)
    return series


def summarise(samples: Mapping[str, Series], absent: Iterable[Absent] = ()) -> Summary:
    """Return the summary of a run.

    Args:
        samples: The series by name, as from ``collect``.
        absent: What could not be read, to be included.

    Example:
        >>> watts = [Reading("ina.VDD_IN", value, "W", "gauge") for value in (5.0, 7.0)]
        >>> recorded = summarise(collect(zip((0.0, 10.0), watts)))
        >>> recorded.energy[0].joules, recorded.energy[0].label
        (60.0, 'module input VDD_IN, without the carrier board')
    """
    missing = list(absent)
    gauges = {name: _gauge(series) for name, series in samples.items() if series.first.kind == "gauge"}
    counters: dict[str, Change] = {}
    for name, series in samples.items():
        if series.first.kind == "counter":
            moved = _difference(series)
            if isinstance(moved, str):
                missing.append(Absent(name, moved))
            else:
                counters[name] = Change(series.first.unit, moved, series.times[-1] - series.times[0], series.note)
    energies = [_energy(total, samples) for total in totals(series.first for series in samples.values())]
    missing += [energy for energy in energies if isinstance(energy, Absent)]
    missing += [] if energies else [Absent("energy", NO_POWER)]
    throttled, throttling = _throttling(gauges, counters)
    times = [time_s for series in samples.values() for time_s in (series.times[0], series.times[-1])]
    return Summary(
        seconds=max(times) - min(times) if times else 0.0,
        energy=tuple(energy for energy in energies if isinstance(energy, Energy)),
        throttled=throttled,
        throttling=throttling,
        gauges=gauges,
        counters=counters,
        unmeasured=tuple(missing),
    )


def difference(values: Sequence[float], wraps: float | None) -> float | None:
    """Add up the changes of a counter from sample to sample.

    A decrease is one wrap-around when the counter has one. Several wrap-arounds between two samples are undetectable:
    the difference is then too small by a multiple of ``wraps``, so sample more often than the counter wraps.

    Returns:
        The difference in the unit of the counter; None when it went back without a wrap-around, or by more than that.

    Example:
        >>> difference([90.0, 98.0, 3.0], wraps=100.0)
        13.0
    """
    moved = 0.0
    for before, after in pairwise(values):
        step = after - before
        if step < 0:
            step += wraps or 0.0
        if step < 0:
            return None
        moved += step
    return moved


def _difference(series: Series) -> float | str:
    if len(series.values) < 2:
        return "read only once, and only differences of a counter are meaningful"
    moved = difference(series.values, series.first.wraps)
    return "the counter went back during the run (its driver was loaded again)" if moved is None else moved


def _gauge(series: Series) -> Gauge:
    values = tuple(series.values)
    low, high = min(values), max(values)
    mean = min(max(sum(values) / len(values), low), high)
    return Gauge(series.first.unit, low, mean, high, tuple(series.times), values, series.note)


def _energy(total: Total, samples: Mapping[str, Series]) -> Energy | Absent:
    """Integrate over the times at which all parts of the total were read."""
    parts = [dict(zip(samples[name].times, samples[name].values, strict=True)) for name in total.names]
    times = sorted(set.intersection(*(set(part) for part in parts)))
    if len(times) < 2:
        return Absent("energy", f"{total.label}: fewer than two samples hold all of {', '.join(total.names)}")
    seconds = times[-1] - times[0]
    joules: float | None
    if total.unit == JOULE:
        moved = [
            difference([part[time_s] for time_s in times], samples[name].first.wraps)
            for name, part in zip(total.names, parts, strict=True)
        ]
        joules = sum(filter(None, moved)) if None not in moved else None
    else:
        joules = _trapezoid(times, [sum(part[time_s] for part in parts) for time_s in times])
    if joules is None:
        return Absent("energy", f"{total.label}: a counter went back during the run")
    source = "power samples" if total.unit == WATT else "counter"
    return Energy(joules, joules / seconds, seconds, total.label, source, total.names, len(times))


def _trapezoid(times: Sequence[float], watts: Sequence[float]) -> float:
    steps = zip(pairwise(times), pairwise(watts), strict=True)
    return sum((after - before) * (first + second) / 2 for (before, after), (first, second) in steps)


def _throttling(gauges: Mapping[str, Gauge], counters: Mapping[str, Change]) -> tuple[bool | None, tuple[str, ...]]:
    flags = [(flag.note or name, flag.max) for name, flag in gauges.items() if flag.unit == THROTTLE]
    events = [(event.note or name, event.difference) for name, event in counters.items() if event.unit == THROTTLE]
    if not flags and not events:
        return None, ()
    words = [f"{what} (set in a sample)" for what, highest in flags if highest > 0]
    words += [f"{what} ({count:g} more)" for what, count in events if count > 0]
    return bool(words), tuple(words)
