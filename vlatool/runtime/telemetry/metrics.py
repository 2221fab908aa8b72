"""Numbers of a run so far: times, misses, interventions with their reasons, drift, alarms."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Any

import numpy as np

from vlatool.runtime.interface import POLICY
from vlatool.runtime.telemetry.histogram import Histogram
from vlatool.runtime.telemetry.record import PARTS, Delivery, TickRecord

TIMES = ("answer", "wait", "sensor age", "age", "latent age", "transport", *PARTS)
"""What is timed of a control step."""
NAMES = 64
"""Most reasons of one kind that are told apart; later ones count as ``OTHER_REASON``."""
OTHER_REASON = "other"
FIRST_STEPS = 1000
"""Control steps whose times later ones are compared with."""


class Metrics:
    """A sink that counts. One thread writes, any may read."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        """Held while a record is counted, and by who reads several numbers."""
        self.steps = self.misses = self.level = 0
        self.times = {name: Histogram() for name in TIMES}
        """What was timed -> its times."""
        self._in_order = tuple(self.times.values())
        self.counts: dict[str, Counter[str]] = {kind: Counter() for kind in ("source", "check", "error", "alarm")}
        """Kind -> reason -> number of control steps."""
        self._early, self._recent = Histogram(), Histogram()
        self._actions = _Moments()

    def __call__(self, record: Any) -> None:
        """Count a record."""
        with self.lock:
            if isinstance(record, Delivery):
                self.times["transport"].add(record.transport_ms)
            elif isinstance(record, TickRecord):
                self._count(record)

    def _count(self, record: TickRecord) -> None:
        self.steps += 1
        self.misses += record.missed
        self.level = record.level
        origin = record.origin
        named = (record.answer_ms, record.waited_ms, record.sensed_ms, origin.age_ms, origin.latent_age_ms,
                 None, *record.parts_ms)  # fmt: skip
        for times, time_ms in zip(self._in_order, named, strict=True):
            if time_ms is not None:
                times.add(time_ms)
        self._note("source", (origin.source,))
        self._note("check", origin.checks)
        self._note("alarm", record.alarms)
        self._note("error", (record.error.partition(":")[0][:80],) if record.error else ())
        if origin.source == POLICY and record.action is not None:
            self._actions.add(record.action)
        self._compare(record.answer_ms)

    def _note(self, kind: str, reasons: Any) -> None:
        counter = self.counts[kind]
        for reason in reasons:
            counter[reason if reason in counter or len(counter) < NAMES else OTHER_REASON] += 1

    def _compare(self, answer_ms: float) -> None:
        """Hold the times of the first control steps apart from those of the last ones."""
        if self._early.count < FIRST_STEPS:
            self._early.add(answer_ms)
            return
        if self._recent.count == FIRST_STEPS:
            self._recent = Histogram()
        self._recent.add(answer_ms)

    @property
    def time_drift(self) -> float:
        """Median time of an answer in the last control steps by that in the first ``FIRST_STEPS``; 1 before that."""
        return self._recent.quantile_ms(0.5) / self._early.quantile_ms(0.5) if self._recent.count else 1.0

    @property
    def action_drift(self) -> float:
        """Largest distance of the mean of an action's element in the last steps from that of the run, in its standard
        deviations in the run; 0 at first.
        """
        return self._actions.drift


class _Moments:
    """Mean and variance of the elements of actions: of all (Welford), and of the last ``FIRST_STEPS``, which fade."""

    def __init__(self) -> None:
        self._count = 0
        self._mean = self._squares = self._recent = np.zeros(0)

    def add(self, action: Any) -> None:
        values = np.ravel(np.asarray(action, np.float64))
        if not np.isfinite(values).all():
            return
        if values.shape != self._mean.shape:
            self._count, self._mean, self._squares, self._recent = 0, values * 0, values * 0, values.copy()
        self._count += 1
        before = values - self._mean
        self._mean = self._mean + before / self._count
        self._squares = self._squares + before * (values - self._mean)
        self._recent = self._recent + (values - self._recent) / min(self._count, FIRST_STEPS / 10)

    @property
    def drift(self) -> float:
        if self._count < FIRST_STEPS:
            return 0.0
        spread = np.sqrt(self._squares / self._count)
        known = spread > 1e-9 * np.abs(self._mean) + 1e-12
        return float(np.max(np.abs(self._recent - self._mean)[known] / spread[known], initial=0.0))
