"""The judgement of a new bundle by its actions: in contract, finite, in time, and within its memory."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import SpecError
from vlatool.files.validate import short_repr
from vlatool.runtime.interface import Action

MIN_LATE = 3
LATE_SHARE = 0.01
"""One overrun is not enough, on a board with other processes: ``MIN_LATE`` and more than this share of all are."""
MEMORY_PERIOD = 16
"""Inferences between two looks at the memory, which take longer than the other checks together."""
SETTLING = 16
"""First inferences after which the memory is taken as the start: engines allocate in them."""
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
PRIVATE_FIELDS = frozenset({
    "normalisation", "statistics", "epsilon", "tokenizer", "max_tokens", "prompt", "finite", "image",
})  # fmt: skip
"""Fields of a tensor that are the policy's own affair: a controller gives and gets the same with any of them."""


class Judge:
    """Says what is wrong with the actions of a policy, one after the other.

    Args:
        latency_ms: limit on an inference in ms; none when 0.
        memory_mb: limit on the growth of this process in 10^6 bytes; none when 0.
        resident_mb: function that returns the memory of this process.
    """

    def __init__(
        self, spec: PolicySpec, latency_ms: float, memory_mb: float, resident_mb: Callable[[], float] | None = None
    ) -> None:
        self._shape = chunk_shape(spec)
        self._latency_ms = latency_ms
        self._memory_mb = memory_mb
        self._resident_mb = resident_mb or resident_memory_mb
        self._start_mb = 0.0
        self.count = 0
        """Number of actions so far."""
        self.late = 0
        self.growth_mb = 0.0

    def violation(self, action: Action, latency_ms: float) -> str:
        """Return what is wrong with the next action or its inference, empty when nothing is.

        Args:
            latency_ms: time of its inference in ms.
        """
        return self.wrong_action(action.chunk) or self.overrun(latency_ms)

    def overrun(self, latency_ms: float) -> str:
        """Return what is wrong with the time of an inference, or with the memory after it; the action may be used."""
        return self._time(latency_ms) or self._memory()

    def count_stop(self) -> str:
        """Count an inference that was stopped before it ended as late; return what is wrong, as ``overrun``."""
        self.count += 1
        return self._time(math.inf)

    def wrong_action(self, chunk: Any) -> str:
        """Return what is wrong with the next chunk, which then must not be used; empty when nothing is."""
        self.count += 1
        if not isinstance(chunk, np.ndarray) or not _fits(chunk.shape, self._shape):
            got = list(chunk.shape) if isinstance(chunk, np.ndarray) else type(chunk).__name__
            return f"action {self.count} is {got}; the spec says {list(self._shape)}"
        if not np.isfinite(chunk).all():
            return f"action {self.count} is not finite"
        return ""

    def _time(self, latency_ms: float) -> str:
        if not self._latency_ms or latency_ms <= self._latency_ms:
            return ""
        self.late += 1
        if self.late < MIN_LATE or self.late <= LATE_SHARE * self.count:
            return ""
        return f"{self.late} of {self.count} inferences took longer than {self._latency_ms:g} ms, or were stopped"

    def _memory(self) -> str:
        if not self._memory_mb or self.count % MEMORY_PERIOD:
            return ""
        now = self._resident_mb()
        if self.count <= SETTLING:
            self._start_mb = now
        self.growth_mb = now - self._start_mb
        if self.growth_mb <= self._memory_mb:
            return ""
        return f"the process grew by {self.growth_mb:,.0f} MB in {self.count} inferences; allowed: {self._memory_mb:g}"


def chunk_shape(spec: PolicySpec) -> tuple[int, ...]:
    """Return the shape of a chunk: (T,) indices, or (T, A); 0 for an axis of any length."""
    free = any(isinstance(axis, str) for axis in spec.action.shape[:-1])
    chunk = 0 if free else spec.chunk
    return (chunk,) if spec.action.kind == "discrete" else (chunk, max(0, spec.action.robot_width))


def _fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    return len(shape) == len(wanted) and all(axis in (0, got) for got, axis in zip(shape, wanted, strict=True))


def resident_memory_mb() -> float:
    """Return the resident memory of this process in 10^6 bytes; 0 where the system does not say it."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        handle = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)  # a stream would take three times as long
        try:
            return int(os.read(handle, 256).split()[1]) * PAGE_BYTES / 1e6
        finally:
            os.close(handle)
    return 0.0


def check_contract(new: PolicySpec, old: PolicySpec) -> None:
    """Refuse a policy that a controller written for another one cannot use.

    Raises:
        SpecError: naming the first field that differs.
    """
    one, other = contract(new), contract(old)
    for name in one:
        if one[name] != other[name]:
            raise SpecError(
                f"The new bundle has another contract than the active one: {name} is {short_repr(one[name])}, before "
                f"{short_repr(other[name])}.",
                "change the controller, and deploy with --new-contract; or make a bundle with the same contract",
            )


def contract(spec: PolicySpec) -> dict[str, Any]:
    """Return what a controller relies on: rates, and inputs and action as the robot gives and gets them."""
    fields: dict[str, Any] = {
        "control_hz": spec.control_hz,
        "chunk": spec.chunk,
        "executed actions": spec.executed_actions,
    }
    fields["inputs"] = sorted(tensor.name for tensor in spec.inputs)
    for tensor in (*spec.inputs, spec.action):
        plain = {**tensor.to_dict(), "unit": tensor.units() or tensor.unit, "frame": tensor.image is not None}
        fields[f"'{tensor.name}'"] = {key: value for key, value in plain.items() if key not in PRIVATE_FIELDS}
    fields["action"] = spec.action.name
    return fields


def inference_period_ms(spec: PolicySpec) -> float:
    """Return the time between two inferences at the control rate in ms; 0 when the rate is unknown."""
    return 1e3 * spec.executed_actions / spec.control_hz if spec.control_hz else 0.0
