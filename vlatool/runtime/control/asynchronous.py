"""A controller that always infers while it acts, and changes to a new chunk as soon as it is there."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.errors import UsageError
from vlatool.runtime.action_elements import ActionElements
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.control._inference import BackgroundInference, Inference, PlayedInference
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.interface import CHUNK, HOLD, POLICY, Array, Origin, Policy


class AsynchronousController(ChunkQueue):
    """Infers without a pause, and leaves out of each chunk as many actions as were executed meanwhile.

    The controller waits for the first chunk alone. When a chunk is used up before the next one is there, the robot
    holds (``ActionElements.hold``); steps at which it held leave nothing out of the next chunk. The delay is counted
    in control steps, from the start of an inference to the step at which its chunk is there. The largest of the last
    ``memory`` counts is expected of the next inference; the first inference, which includes the warm-up of an engine,
    does not count.

    Args:
        execute: Number of actions to execute from each chunk before the next inference starts; 1 when 0.
        delay: Number of control steps that an inference takes; with ``background`` the number that is expected of
            the first one.
        memory: Number of inferences after which a delay is forgotten.
        background: Whether to infer in a thread of its own, as on a robot. Otherwise ``act`` infers at once and
            withholds the chunk for ``delay`` steps, so that the actions depend on nothing but the observations.
        clock: See ``ChunkQueue``.

    Raises:
        UsageError: when an argument is not a whole number in its range.
    """

    def __init__(
        self, policy: Policy, execute: int = 0, *, delay: int = 0, memory: int = 10, background: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        check_whole("delay", delay, 0)
        check_whole("memory", memory, 1)
        self._elements = ActionElements(policy.spec.action)
        self.background = background
        """Whether inferences run in a thread of their own."""
        self._inference: Inference = BackgroundInference(policy) if background else PlayedInference(policy, delay)
        self._delays: deque[int] = deque(maxlen=memory)
        self._first_delay = delay
        super().__init__(policy, execute or 1, clock=clock)

    @property
    def expected_delay(self) -> int:
        """Number of control steps that the next inference is expected to take."""
        return max(self._delays, default=self._first_delay)

    def _forget(self) -> None:
        super()._forget()
        self._inference.cancel()
        self._last: Array | None = None
        self._asked_at = self._observed = 0.0
        """When the inference started, and when the one did whose chunk is executed."""
        self._steps = 0
        """Control steps since the inference started that runs, or that ran last."""
        self._executed = 0.0
        """Actions of the chunk that were executed since then, of which the next chunk leaves out as many."""
        self._position = 0.0
        """Actions of the chunk that were executed or left out."""
        self._speed = 1.0
        """Actions of the chunk that each control step executes."""

    def _step(self, observation: Mapping[str, Any]) -> Array:
        arrived = self._arrival()
        if self._inference.running or not self._due():
            self._inference.observe(observation)
        else:
            arrived = self._start(observation) or arrived
        self.fresh = arrived
        self._steps += 1
        self._last = self._next()
        return self._last

    def _arrival(self) -> bool:
        """Change to the chunk of an inference that has ended; return whether one has."""
        chunk = self._inference.poll(self._steps)
        if chunk is None:
            return False
        self._delays.append(self._steps)
        self._observed = self._asked_at
        self._begin(chunk)
        return True

    def _due(self) -> bool:
        """Return whether an inference should start at this step."""
        return self._last is None or not self._pending or (self._steps > 0 and self._position >= self.execute)

    def _start(self, observation: Mapping[str, Any]) -> bool:
        """Start an inference; return whether its chunk is there at once: the first one is waited for."""
        self._inference.start(self._asked(observation))
        self._asked_at = self._clock()
        self._steps, self._executed = 0, 0.0
        if self._last is None:
            chunk = self._inference.wait()
            self._observed = self._asked_at
            self._begin(chunk)
            return True
        return self._arrival()

    def _asked(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the observation as the policy is given it."""
        return observation

    def _begin(self, chunk: Array) -> None:
        self._pending = list(chunk[int(self._executed) :])
        self._position = self._executed

    def rest(self) -> Array | None:
        """Return the next action of the last chunk; None when there is none. It answers a step that has no other."""
        with self._turn:
            if not self._pending:
                return None
            self.fresh = False
            self._steps += 1
            self._last = self._next()
            self.origin = self.origin._replace(source=CHUNK)
            return self._last.copy()

    def _next(self) -> Array:
        age_ms, lead_ms = (self._clock() - self._observed) * 1e3, self._inference.lead_ms
        latent_ms = None if lead_ms is None else age_ms + lead_ms
        self.origin = Origin(POLICY if self._pending else HOLD, age_ms, latent_age_ms=latent_ms)
        if not self._pending:
            if self._last is None:
                raise UsageError("The policy gives a chunk without actions.", "let it give one action at least")
            return self._elements.hold(self._last)
        self._executed += self._speed
        self._position += self._speed
        return np.asarray(self._pending.pop(0))
