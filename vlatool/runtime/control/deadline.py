"""A policy that answers by a deadline, whatever the engine of the policy inside it does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from vlatool.errors import DeadlineMissed
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.interface import Action, Array, Policy, layers_of, observer_of
from vlatool.runtime.worker import Worker


class Deadline:
    """Infers in a thread of its own, and raises at the deadline if there is no action then.

    At the deadline, a running inference is stopped: between two nodes of its graph by ONNX Runtime and by OpenVINO,
    where the wrapped policy has ``stop`` and ``resume``. Its result is discarded and the policy is as it was before
    (``snapshot`` and ``restore``). What cannot be stopped (one node that takes hours, a loop within OpenVINO, a policy
    of another package) is not waited for either: the policy is then busy, and each ``infer`` raises at once, until it
    ends; no second thread is started.

    Args:
        deadline_ms: Time until ``infer`` returns or raises, from ``started``, in milliseconds; a control period of the
            spec when None.
        clock: Returns seconds.
        worker: What runs the inferences; a thread when None.

    Raises:
        UsageError: when the deadline is not a number above 0.
        SpecError: when it is None, and the rate of the spec is unknown.
    """

    def __init__(
        self,
        policy: Policy,
        deadline_ms: float | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        worker: Worker | None = None,
    ) -> None:
        check_positive("deadline_ms", deadline_ms, "a number of milliseconds", optional=True)
        self.policy, self.spec = policy, policy.spec
        self._observer = observer_of(policy)
        self.deadline_ms = 1000 / policy.spec.rate if deadline_ms is None else float(deadline_ms)
        self.started: float | None = None
        """Time of the clock at which the control step was to begin; the call of ``infer`` when None or after it."""
        self._clock = clock
        self._worker = Worker("vlatool-inference", clock) if worker is None else worker
        self.spent_ns: tuple[int, int, int, int] | None = None
        """Nanoseconds of the last ``infer``: encoding, graphs (or all, where nobody says it or there is no action),
        decoding, and the way to the thread and back."""
        self._timed = next((layer for layer in layers_of(policy) if hasattr(layer, "spent_ns")), None)
        self._engine = next((layer for layer in layers_of(policy) if _stops(layer)), None)
        self._reset: tuple[int | None] | None = None

    @property
    def busy(self) -> bool:
        """Whether an inference is running, such as one that missed its deadline and cannot be stopped."""
        return self._worker.busy

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk.

        Raises:
            DeadlineMissed: when the inference does not end in time, or an earlier one that was stopped still runs.
            DataError, GraphError, UsageError: as the policy's ``infer`` does.
        """
        now, begin = self._clock(), time.perf_counter_ns()
        started = now if self.started is None else min(self.started, now)
        inference = _Inference(self.policy, self._engine, observation, noise, self._reset)
        try:
            action: Action = self._worker.call(inference, started + self.deadline_ms / 1e3)
        except TimeoutError as error:
            self.spent_ns = 0, time.perf_counter_ns() - begin, 0, 0
            raise DeadlineMissed(f"There is no action within {self.deadline_ms:g} ms: {error}.") from None
        self._reset = None
        self._note(time.perf_counter_ns() - begin)
        return action

    def _note(self, taken: int) -> None:
        spent = None if self._timed is None else self._timed.spent_ns
        self.spent_ns = (0, taken, 0, 0) if spent is None else (*spent[:3], taken - sum(spent))

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation of a control step at which it does not infer."""
        if self._observer is not None:
            self._observer.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, before the next inference where one is still running; see ``Policy.reset``."""
        check_whole("seed", seed, 0, optional=True)
        self._reset = (seed,)
        if not self.busy:
            self.policy.reset(seed)
            self._reset = None

    def close(self) -> None:
        """End the thread of the inferences; the next one starts another."""
        self._worker.close()


def _stops(layer: Any) -> bool:
    return hasattr(layer, "stop") and hasattr(layer, "resume")


class _Inference:
    """One inference as a worker's task."""

    def __init__(
        self,
        policy: Policy,
        engine: Any,
        observation: Mapping[str, Any],
        noise: Mapping[str, Array] | None,
        reset: tuple[int | None] | None,
    ) -> None:
        self._policy, self._engine, self._reset = policy, engine, reset
        self._observation, self._noise = observation, noise
        self._snapshot: Any = None

    def begin(self) -> None:
        """Allow the engine to run."""
        if self._engine is not None:
            self._engine.resume()

    def run(self) -> Action:
        """Infer, after a reset that could not be done earlier."""
        if self._reset is not None:
            self._policy.reset(*self._reset)
        self._snapshot = getattr(self._engine, "snapshot", None)
        return self._policy.infer(self._observation, noise=self._noise)

    def stop(self) -> None:
        """End the run of the engine."""
        if self._engine is not None:
            self._engine.stop()

    def undo(self) -> None:
        """Put the policy back to where it was before."""
        if self._snapshot is not None:
            self._engine.restore(self._snapshot)
