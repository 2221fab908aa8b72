"""A policy of two systems: a slow part sees and understands, a fast part acts on the newest values that it gave."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from vlatool.bundle.program import SlowPart
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import UsageError
from vlatool.files.printable import amount
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.control._inference import Moments
from vlatool.runtime.control._slow_part import Beside, EveryInference
from vlatool.runtime.interface import Action, Array, Policy, observer_of
from vlatool.runtime.observation import EncodedObservation
from vlatool.runtime.policy import BundlePolicy
from vlatool.runtime.two_parts import parts_of
from vlatool.runtime.worker import Worker


class DualRate:
    """Runs the slow part of a policy of two systems less often than the fast part, or beside it in a thread.

    Such policies are Helix, GR00T N1 and others with a "System 2" and a "System 1": a vision-language model at 2 to 10
    Hz gives a latent vector or a subtask, an action network at 50 to 200 Hz uses the newest one. The program of the
    bundle says which steps are slow (``slow``). Each ``infer`` runs the fast part alone. ``Action.latent_age_ms`` says
    how old the observation is that the values of the slow part answer.

    With ``thread``, as on a robot, the slow part runs in a thread of its own, on a copy of the observation, whenever it
    is ready or at the rate of the program. The fast part waits for the first values after a reset, and never again. If
    the newest values are older than ``max_age_ms``, ``infer`` raises, and so it does, once, with what a run of the slow
    part raised: a fallback answers. A run that takes longer than that is stopped.

    Without, all depends on the observations alone, for an evaluation or a replay: the slow part runs at every
    ``every``-th inference since the reset, and its values are used ``late`` inferences afterwards.

    Args:
        every: Number of inferences from one run of the slow part to the next; when 0, as many as the rates of the
            program and of the spec say, or 1 where the slow part runs whenever it is ready.
        thread: Whether the slow part runs in a thread of its own.
        late: Number of inferences that a run of the slow part is to take, without a thread.
        max_age_ms: Age of values above which they are not used, in milliseconds; that of the program when None.
        hz: Rate of the slow part in Hz, 0 for whenever it is ready; that of the program when None.
        clock: Returns seconds.
        worker: What runs the slow part; a thread when None.

    Raises:
        UsageError: when the policy has no slow part, or a wrapper is between it and this; an argument is out of its
            range, or values would be too old at the planned rate.
    """

    def __init__(
        self,
        policy: Policy,
        every: int = 0,
        *,
        thread: bool = False,
        late: int = 0,
        max_age_ms: float | None = None,
        hz: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        worker: Worker | None = None,
    ) -> None:
        part = _slow_part(policy)
        check_positive("max_age_ms", max_age_ms, "a number of milliseconds", optional=True)
        check_positive("hz", hz, "a number of Hz", zero=True, optional=True)
        check_whole("every", every, 0)
        check_whole("late", late, 0)
        part = SlowPart(max_age_ms or part.max_age_ms, part.hz if hz is None else hz or None)
        self.policy, self.spec, self.slow = policy, policy.spec, part
        self.thread = thread
        """Whether the slow part runs in a thread of its own."""
        self._slow, self._fast = _parts(policy)
        self._observer = observer_of(self._fast)
        self._moments = Moments(policy.spec, self._slow.names)
        if thread and (every or late):
            raise UsageError("every and late are for a slow part without a thread of its own.", "leave them out")
        period_ms = _period_ms(policy.spec)
        self._rhythm: Beside | EveryInference = (
            Beside(self._slow, part, clock, worker) if thread else
            EveryInference(self._slow, _checked(every, late, part, period_ms), late, period_ms)
        )  # fmt: skip
        self.spent_ns: tuple[int, int, int, int] | None = None
        """Nanoseconds of the last inference, as ``BundlePolicy.spent_ns``; with those of the slow part, or of the wait
        for its values, in the graphs."""

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk. An inference that raises has no effect on the fast part.

        Args:
            noise: As ``BundlePolicy.infer`` takes it; that of the slow part is used where this inference starts it.

        Raises:
            DeadlineMissed: when the values of the slow part are too old, or a run of it takes too long.
            DataError, GraphError: as either part does.
            TimeoutError: when ``stop`` is called.
        """
        begin = time.perf_counter_ns()
        windowed = self._moments.lengths and not isinstance(observation, EncodedObservation)
        seen = {**observation, **self._moments.add(observation)} if windowed else observation
        slow, fast = self._shared(noise)
        before = None if self.thread else self._rhythm.snapshot
        thought = self._rhythm.latest(seen, slow)
        self._fast.latent = thought.values
        waited = time.perf_counter_ns() - begin
        try:
            action: Action = self._fast.infer(observation, noise=fast)
        except BaseException:
            if before is not None:
                self._rhythm.restore(before)
            raise
        if (spent := getattr(self._fast, "spent_ns", None)) is not None:
            self.spent_ns = spent[0], spent[1] + waited, spent[2], 0
        waited_ms = waited / 1e6
        return action._replace(latency_ms=action.latency_ms + waited_ms, age_ms=action.age_ms + waited_ms,
                               latent_age_ms=self._rhythm.age_ms(thought))  # fmt: skip

    def _shared(self, noise: Mapping[str, Array] | None) -> tuple[dict[str, Array] | None, dict[str, Array] | None]:
        """Return the noise of the slow part, and the rest, which the fast part refuses where it draws no such noise."""
        if not isinstance(noise, Mapping):
            return None, noise
        own = {name: value for name, value in noise.items() if name in self._slow.noise}
        return own, {name: value for name, value in noise.items() if name not in own}

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep the observation of a control step without an inference, for inputs with a ``history``."""
        if self._moments.lengths:
            self._moments.add(observation)
        if self._observer is not None:
            self._observer.observe(observation)

    def stop(self) -> None:
        """End the inference in progress, from another thread; a slow part in a thread of its own goes on."""
        self._rhythm.stop()
        self._fast.stop()

    def resume(self) -> None:
        """Allow inferences again after ``stop``."""
        self._rhythm.resume()
        self._fast.resume()

    @property
    def snapshot(self) -> tuple[Any, Any]:
        """What ``restore`` takes."""
        return self._fast.snapshot, self._rhythm.snapshot

    def restore(self, snapshot: tuple[Any, Any]) -> None:
        """Take back the last inference; new values of a slow part in a thread of its own stay."""
        self._fast.restore(snapshot[0])
        self._rhythm.restore(snapshot[1])

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode of both parts: the values of the slow part are forgotten."""
        check_whole("seed", seed, 0, optional=True)
        self._fast.reset(seed)
        self._rhythm.reset(seed)
        self._moments.clear()

    def close(self) -> None:
        """End the thread of the slow part; the next inference starts another."""
        self._rhythm.close()


def _slow_part(policy: Policy) -> SlowPart:
    part: SlowPart | None = getattr(policy, "slow", None)
    if part is not None and (isinstance(policy, BundlePolicy) or hasattr(policy, "parts")):
        return part
    inside = getattr(policy, "policy", None)
    if inside is not None:
        raise UsageError(
            f"dual_rate cannot be around {type(policy).__name__}: it runs the two parts of a bundle in its place.",
            "name dual_rate before the other wrappers of the policy",
        )
    raise UsageError(
        "The policy has no slow part: no step of its program says 'slow'.",
        "leave dual_rate out, or say in policy.yaml which steps are slow: slow: {max_age_ms: 500}",
    )


def _parts(policy: Any) -> tuple[Any, Any]:
    """Return the slow part of a policy and the fast one; another policy than an open bundle has them as ``parts()``."""
    return parts_of(policy) if isinstance(policy, BundlePolicy) else policy.parts()


def _period_ms(spec: PolicySpec) -> float | None:
    """Return the time from one inference to the next as planned, in milliseconds; None at an unknown rate."""
    return 1000 * spec.executed_actions / spec.control_hz if spec.control_hz else None


def _checked(every: int, late: int, part: SlowPart, period_ms: float | None) -> int:
    """Return how many inferences there are for each run of the slow part; raises UsageError where that is too many."""
    if not every:
        every = 1 if part.hz is None or period_ms is None else max(1, round(1000 / part.hz / period_ms))
    if late > every:
        raise UsageError(f"late is {late}, and the slow part runs again after {amount(every, 'inference')}.",
                         f"pass late from 0 to {every}")  # fmt: skip
    oldest = every - 1 + late
    if period_ms is not None and oldest * period_ms > part.max_age_ms:
        raise UsageError(
            f"The slow part would run at each {every}. inference, and its values be used up to "
            f"{oldest * period_ms:g} ms after their observation; allowed: {part.max_age_ms:g} ms.",
            f"pass every={max(1, int(part.max_age_ms / period_ms) + 1 - late)}, or allow older values: max_age_ms",
        )
    return every
