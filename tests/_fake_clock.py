"""A clock that stands still until it is moved, and what runs by it: no test sleeps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from _numbered import NumberedPolicy

from vlatool.bundle.spec import PolicySpec
from vlatool.runtime.interface import Action


class FakeClock:
    """Seconds since it was made, as they are set."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class FakeWorker:
    """A worker whose tasks take what they add to the clock: it goes no further than the deadline of the caller.

    Args:
        stops: Whether a task ends when it is stopped; otherwise the worker is busy until it would have ended.
    """

    def __init__(self, clock: FakeClock, stops: bool = True) -> None:
        self.clock, self.stops, self.until = clock, stops, 0.0
        self.calls = 0

    @property
    def busy(self) -> bool:
        return self.clock.now < self.until

    def call(self, task: Any, due: float) -> Any:
        """Run a task as ``Worker.call`` does."""
        if self.busy:
            raise TimeoutError("one that was stopped before has not ended yet")
        if self.clock.now >= due:
            raise TimeoutError("no time is left for it")
        self.calls += 1
        task.begin()
        error = None
        try:
            result = task.run()
        except Exception as raised:
            error = raised
        if self.clock.now > due:
            self.until = due if self.stops else self.clock.now
            self.clock.now = due
            task.stop()
            if error is None:
                task.undo()
            raise TimeoutError("it was stopped")
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """Nothing runs."""


class SlowPolicy(NumberedPolicy):
    """Takes as long as the next number of ``delays_ms`` says, in milliseconds, 0 after the last of them."""

    def __init__(self, spec: PolicySpec, clock: FakeClock, delays_ms: list[float] | None = None) -> None:
        super().__init__(spec)
        self.clock, self.delays_ms = clock, list(delays_ms or [])

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        """Return the chunk that belongs to a control step, after its delay."""
        taken_ms = self.delays_ms.pop(0) if self.delays_ms else 0.0
        self.clock.now += taken_ms / 1e3
        return super().infer(observation, noise=noise)._replace(latency_ms=taken_ms, age_ms=taken_ms)
