"""Where the time of each control step went."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vlatool.runtime.telemetry.record import PARTS, Delivery, TickRecord

BEFORE, AFTER = ("sensor age", "wait"), ("transport",)
WHOLE, LATENT = "whole", "latent age"


class Stopwatch:
    """Reads what the layers of a stack say of their last step.

    A policy, or the deadline around it, has ``spent_ns`` of its last inference: the nanoseconds of encoding, graphs,
    decoding, and the way to another thread and back. An envelope has ``taken_ns``. The rest belongs to ``control``.

    Args:
        chains: The layers around each policy, the outermost first.
        beside: Whether inferences run beside the control steps, and do not belong to them.
    """

    def __init__(self, chains: Iterable[Iterable[Any]], *, beside: bool = False) -> None:
        found = [list(chain) for chain in chains]
        timed = [next((layer for layer in chain if hasattr(layer, "spent_ns")), None) for chain in found]
        self._timed = [] if beside else [layer for layer in timed if layer is not None]
        self._envelopes = [layer for chain in found for layer in chain if hasattr(layer, "taken_ns")]

    def begin(self) -> None:
        """Begin a control step."""
        for layer in self._timed:
            layer.spent_ns = None
        for layer in self._envelopes:
            layer.taken_ns = 0

    def parts_ms(self, acted_ms: float) -> tuple[float, ...]:
        """Return the milliseconds of each of ``PARTS`` of a step that has taken so long from the call of ``act``."""
        encode = infer = decode = handover = envelope = 0
        for layer in self._timed:
            if (spent := layer.spent_ns) is not None:
                encode, infer, decode = encode + spent[0], infer + spent[1], decode + spent[2]
                handover += spent[3]
        for layer in self._envelopes:
            envelope += layer.taken_ns
        rest = acted_ms - (encode + infer + decode + handover + envelope) / 1e6
        return encode / 1e6, infer / 1e6, decode / 1e6, handover / 1e6, envelope / 1e6, rest


@dataclass(frozen=True)
class PartTime:
    """The time of one part of the control steps.

    Args:
        part: Its name.
        steps: Number of control steps that say it.
        mean_ms: Mean of them, in milliseconds.
        p50_ms: Median.
        p99_ms: 99th percentile, the largest of fewer than a hundred.
        max_ms: Largest.
        share: Part of the mean of the whole step.
    """

    part: str
    steps: int
    mean_ms: float
    p50_ms: float
    p99_ms: float
    max_ms: float
    share: float


@dataclass(frozen=True)
class CadenceReport:
    """Where the time of a run's control steps went.

    Args:
        parts: From the measurement that an action answers to the robot; the last is the whole step. The means of the
            parts sum to that of the whole.
        misses: Steps at which the policy had no action.
        latent: Of a policy of two systems, the age of the values of its slow part when an action was returned, which
            belongs to no control step (share 0); None where no action says it.
    """

    parts: tuple[PartTime, ...]
    misses: int
    latent: PartTime | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return asdict(self)


class Cadence:
    """A sink that sums up where the time of the last control steps went.

    Args:
        steps: Number of control steps of which it holds the times, the last ones.
    """

    def __init__(self, steps: int = 100_000) -> None:
        self._rows = np.zeros((steps, len(BEFORE) + len(PARTS) + len(AFTER)), np.float32)
        self._told = np.zeros(self._rows.shape[1], bool)
        self._steps = np.full(steps, -1, np.int64)
        self._latent = np.full(steps, np.nan, np.float32)
        self._count = self.misses = 0

    def __call__(self, record: Any) -> None:
        """Take a record."""
        size = len(self._rows)
        if isinstance(record, Delivery):
            if self._steps[record.step % size] == record.step:
                self._rows[record.step % size, -1] = record.transport_ms
                self._told[-1] = True
            return
        if not isinstance(record, TickRecord):
            return
        row = (record.sensed_ms or 0.0, record.waited_ms, *record.parts_ms, 0.0)
        self._rows[record.step % size], self._steps[record.step % size] = row, record.step
        latent = record.origin.latent_age_ms
        self._latent[record.step % size] = np.nan if latent is None else latent
        self._told[: len(row) - 1] |= [record.sensed_ms is not None, *[True] * (len(row) - 2)]
        self._count += 1
        self.misses += record.missed

    def report(self) -> CadenceReport:
        """Return what is known so far; without parts before the first control step."""
        rows = self._rows[self._steps >= 0].astype(np.float64)
        if not len(rows):
            return CadenceReport((), 0)
        whole = rows.sum(1)
        columns = [(name, rows[:, index]) for index, name in enumerate((*BEFORE, *PARTS, *AFTER)) if self._told[index]]
        ages = self._latent[np.isfinite(self._latent)].astype(np.float64)
        return CadenceReport(tuple(_part(name, times, whole.mean()) for name, times in [*columns, (WHOLE, whole)]),
                             self.misses, _part(LATENT, ages, 0.0) if len(ages) else None)  # fmt: skip


def _part(name: str, times: Any, whole: float) -> PartTime:
    mean, p99 = float(times.mean()), float(np.percentile(times, 99, method="higher"))
    share = mean / whole if whole else 0.0
    return PartTime(name, len(times), mean, float(np.median(times)), p99, float(times.max()), share)


def cadence_lines(report: Mapping[str, Any] | CadenceReport) -> list[str]:
    """Return a table for a person: each part with its median, 99th percentile, largest and share."""
    if not isinstance(report, CadenceReport):
        latent = report.get("latent")
        parts = tuple(PartTime(**each) for each in report["parts"])
        report = CadenceReport(parts, report["misses"], None if latent is None else PartTime(**latent))
    lines = [f"  {'where a control step went':<26}{'mean':>9}{'p50':>9}{'p99':>9}{'max ms':>9}{'share':>8}"]
    for each in (*report.parts, *filter(None, [report.latent])):
        numbers = "".join(f"{value:9.3f}" for value in (each.mean_ms, each.p50_ms, each.p99_ms, each.max_ms))
        lines.append(f"  {each.part:<26}{numbers}{'' if each is report.latent else f'{each.share:>8.1%}'}")
    return lines
