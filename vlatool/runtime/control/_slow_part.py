"""When the slow part of a policy of two systems runs: at every k-th inference, or in a thread of its own."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from vlatool.bundle.program import SlowPart
from vlatool.errors import DeadlineMissed, VlatoolError
from vlatool.runtime.interface import Array
from vlatool.runtime.observation import EncodedObservation
from vlatool.runtime.worker import Call, Worker

LOOK_S = 0.005
"""Time between two looks at whether somebody has stopped the wait for the first values."""
EARLY_SHARE = 1e-6
"""Share of a period by which the slow part may start early: clocks are rounded."""
Noise = Mapping[str, Array]


class Runner(Protocol):
    """The slow part of a policy, as ``vlatool.runtime.two_parts.SlowRunner`` has it."""

    names: tuple[str, ...]
    noise: set[str]
    snapshot: Any

    def run(self, observation: Mapping[str, Any], *, noise: Noise | None = None) -> Mapping[str, Any]:
        """Return what the fast part takes; a run that raises has no effect."""

    def stop(self) -> None:
        """End the run in progress, from another thread; it and later ones raise TimeoutError until ``resume``."""

    def resume(self) -> None:
        """Allow runs again."""

    def restore(self, snapshot: Any) -> None:
        """Take back what was run since a snapshot."""

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode."""


class Thought(NamedTuple):
    """What the slow part gave for one observation.

    Args:
        values: Value name -> array.
        observed: When the observation was: seconds of the clock, or the number of the inference.
    """

    values: Mapping[str, Any]
    observed: float


class EveryInference:
    """Runs the slow part at every k-th inference, in the same thread, so that all depends on the observations alone.

    Args:
        every: Number of inferences from one run to the next.
        late: Number of inferences after which values are used first, as if the slow part took that long; the first
            ones are used at once.
        period_ms: Time from one inference to the next as planned, in milliseconds; None where nobody knows.
    """

    def __init__(self, slow: Runner, every: int, late: int, period_ms: float | None) -> None:
        self._slow, self._every, self._late, self._period_ms = slow, every, late, period_ms
        self._forget()

    def _forget(self) -> None:
        self._number = 0
        self._used: Thought | None = None
        self._coming: Thought | None = None

    def latest(self, observation: Mapping[str, Any], noise: Noise | None) -> Thought:
        """Return the values that this inference uses; raises what a run raises, which then has no effect."""
        number = self._number
        if number % self._every == 0:
            self._coming = Thought(self._slow.run(observation, noise=noise), number)
        if self._coming is not None and (self._used is None or number - self._coming.observed >= self._late):
            self._used, self._coming = self._coming, None
        self._number += 1
        return self._used  # type: ignore[return-value]  # the first inference has set it

    def age_ms(self, thought: Thought) -> float | None:
        """Return the age of values at the last inference, in planned time."""
        return None if self._period_ms is None else (self._number - 1 - thought.observed) * self._period_ms

    @property
    def snapshot(self) -> Any:
        """What ``restore`` takes."""
        return self._number, self._used, self._coming, self._slow.snapshot

    def restore(self, snapshot: Any) -> None:
        """Take back the last inference."""
        self._number, self._used, self._coming, slow = snapshot
        self._slow.restore(slow)

    def stop(self) -> None:
        """End the run in progress."""
        self._slow.stop()

    def resume(self) -> None:
        """Allow runs again."""
        self._slow.resume()

    def reset(self, seed: int | None) -> None:
        """Start a new episode."""
        self._slow.reset(seed)
        self._forget()

    def close(self) -> None:
        """Nothing runs."""


class Beside:
    """Runs the slow part in a thread of its own, whenever it is ready, or at its rate.

    A run that takes longer than values may be old is stopped. What a run raises is raised by the next inference, once.

    Args:
        clock: Returns seconds.
        worker: What runs the slow part; a thread when None.
    """

    def __init__(self, slow: Runner, part: SlowPart, clock: Callable[[], float], worker: Worker | None = None) -> None:
        self._slow, self._part, self._clock = slow, part, clock
        self._worker = Worker("vlatool-slow-part", clock) if worker is None else worker
        self._resets: list[int | None] = []
        self._stopped = False
        self._forget()

    def _forget(self) -> None:
        self._newest: Thought | None = None
        self._call: Call | None = None
        self._started = -float("inf")

    def latest(self, observation: Mapping[str, Any], noise: Noise | None) -> Thought:
        """Return the newest values; the first after a reset are waited for.

        Raises:
            DeadlineMissed: when they are too old, a run took longer than they may be old, or the wait is stopped.
            Exception: what a run raised.
        """
        failure = self._take()
        if self._call is None and self._clock() >= self._started + (1 - EARLY_SHARE) / (self._part.hz or float("inf")):
            self._start(observation, noise)
        if failure is None and self._newest is None:
            failure = self._wait_for_first(observation, noise)
        if failure is not None:
            raise failure
        thought = self._newest
        if thought is None or (age := self._age_ms(thought)) > self._part.max_age_ms:
            raise DeadlineMissed(
                "The slow part has given no values yet." if thought is None else
                f"The values of the slow part are {age:.0f} ms old; allowed: {self._part.max_age_ms:g} ms.",
                "values are used until the next are there: allow them twice the time that the slow part takes, and a "
                "period of its rate",
            )  # fmt: skip
        return thought

    def _take(self) -> Exception | None:
        """Take the values of a run that has ended, and return why there are none; None where it goes on, too."""
        call = self._call
        if call is None:
            return None
        if not call.ended:
            if self._clock() <= call.due or not self._worker.abandon(call):
                return None
            self._call = None
            return self._too_long()
        self._call = None
        try:
            values = call.outcome()
        except TimeoutError:
            return self._too_long()
        except Exception as error:  # the seam: the ladder answers whatever it is
            return _of_the_slow_part(error)
        self._newest = Thought(values, self._started)
        return None

    def _too_long(self) -> DeadlineMissed:
        return DeadlineMissed(
            f"The slow part takes longer than its values may be old, {self._part.max_age_ms:g} ms: it was stopped.",
            "make it faster, or allow older values: dual_rate:max_age_ms=1000",
        )

    def _start(self, observation: Mapping[str, Any], noise: Noise | None) -> None:
        """Start a run with a copy of what it takes; nothing where one that was stopped has not ended yet."""
        now = self._clock()
        values = {name: _copied(observation[name]) for name in self._slow.names if name in observation}
        seen = EncodedObservation(values) if isinstance(observation, EncodedObservation) else values
        try:
            run = _Run(self._slow, seen, noise, self._resets)
            self._call = self._worker.start(run, now + self._part.max_age_ms / 1e3)
        except TimeoutError:
            return
        self._started = now

    def _wait_for_first(self, observation: Mapping[str, Any], noise: Noise | None) -> Exception | None:
        """Return why there are no first values, when the run has ended; None where they are there."""
        end = self._clock() + self._part.max_age_ms / 1e3
        while self._newest is None and not self._stopped:
            if self._call is None:  # one of the episode before has not ended
                self._start(observation, noise)
            if self._call is not None:
                self._worker.wait(self._call, LOOK_S)
            if (failure := self._take()) is not None:
                return failure
            if self._newest is None and self._clock() > end:
                return self._too_long()
        return None

    def _age_ms(self, thought: Thought) -> float:
        return (self._clock() - thought.observed) * 1e3

    def age_ms(self, thought: Thought) -> float | None:
        """Return the age of values now, in milliseconds."""
        return self._age_ms(thought)

    @property
    def snapshot(self) -> Any:
        """Nothing: a run that goes on beside the inferences is not taken back with one of them."""
        return None

    def restore(self, snapshot: Any) -> None:
        """Values that are there stay."""

    def stop(self) -> None:
        """End the wait for the first values; the run goes on."""
        self._stopped = True

    def resume(self) -> None:
        """Allow waits again."""
        self._stopped = False

    def reset(self, seed: int | None) -> None:
        """Start a new episode: a run that goes on is stopped, and its values are not used."""
        if self._call is not None:
            self._worker.abandon(self._call)
        self._forget()
        self._resets[:] = [seed]

    def close(self) -> None:
        """End the thread; the next inference starts another."""
        self._worker.close()


class _Run:
    """One run of the slow part as a worker's task."""

    def __init__(
        self, slow: Runner, observation: Mapping[str, Any], noise: Noise | None, resets: list[int | None]
    ) -> None:
        self._slow, self._observation, self._noise, self._resets = slow, observation, noise, resets
        self._snapshot: Any = None

    def begin(self) -> None:
        """Allow the engine to run."""
        self._slow.resume()

    def run(self) -> Mapping[str, Any]:
        """Run, after the reset of a new episode."""
        while self._resets:
            self._slow.reset(self._resets.pop())
        self._snapshot = self._slow.snapshot
        return self._slow.run(self._observation, noise=self._noise)

    def stop(self) -> None:
        """End the run of the engine."""
        self._slow.stop()

    def undo(self) -> None:
        """Take back what the run did."""
        self._slow.restore(self._snapshot)


def _copied(value: Any) -> Any:
    return value if isinstance(value, str) else copy.deepcopy(value)


def _of_the_slow_part(error: Exception) -> Exception:
    if isinstance(error, VlatoolError):
        error.message = f"The slow part: {error.message}"
    return error
