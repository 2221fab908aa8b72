"""Inferences that run while a controller acts: played, with a fixed delay, or in a thread of their own."""

from __future__ import annotations

import copy
import queue
import threading
import weakref
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import DataError
from vlatool.runtime.interface import Action, Array, Policy, observer_of
from vlatool.runtime.process_end import EXIT_S, close_at_exit


class Inference(Protocol):
    """One inference at a time, beside the control steps."""

    running: bool
    lead_ms: float | None
    """How much older the observation is that the values of a slow part answer than that of the last chunk, in ms."""

    def start(self, observation: Mapping[str, Any]) -> None:
        """Start an inference with the observation of this control step."""

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep the observation of a control step at which none starts."""

    def poll(self, steps: int) -> Array | None:
        """Return the chunk of an inference that has ended, once.

        Args:
            steps: Number of control steps since the one at which it started.

        Raises:
            VlatoolError: as the policy's ``infer`` does; the inference has then ended, too.
        """

    def wait(self) -> Array:
        """Return the chunk of the inference that runs when it has ended."""

    def cancel(self) -> None:
        """Discard the inference that runs, and all observations; return when it has ended."""


class PlayedInference:
    """Infers at once and withholds the chunk for a number of control steps, so that it depends on nothing else."""

    def __init__(self, policy: Policy, delay: int) -> None:
        self.running = False
        self.lead_ms: float | None = None
        self._policy, self._delay, self._observer = policy, delay, observer_of(policy)

    def start(self, observation: Mapping[str, Any]) -> None:
        """Infer."""
        self._action = self._policy.infer(observation)
        self.running = True

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Give the policy the observation, if it has inputs of several moments."""
        if self._observer is not None:
            self._observer.observe(observation)

    def poll(self, steps: int) -> Array | None:
        """Return the chunk ``delay`` control steps after its start."""
        return self.wait() if self.running and steps >= self._delay else None

    def wait(self) -> Array:
        """Return the chunk."""
        self.running, self.lead_ms = False, _lead_ms(self._action)
        return self._action.chunk

    def cancel(self) -> None:
        """Discard the chunk."""
        self.running = False


class BackgroundInference:
    """Infers in a thread of its own, which ends when this object is collected, or with the process.

    An observation is copied before the thread gets it. Inputs that hold several moments are given whole, since the
    policy itself might see the moments in another order than they came.
    """

    def __init__(self, policy: Policy) -> None:
        self.running = False
        self.lead_ms: float | None = None
        self._moments = Moments(policy.spec)
        thread = _InferenceThread(policy.infer)
        self._work, self._answers = thread.work, thread.answers
        weakref.finalize(self, self._work.put, None)

    def start(self, observation: Mapping[str, Any]) -> None:
        """Hand the observation to the thread."""
        self._work.put(self._moments.add(observation))
        self.running = True

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep a moment of the inputs that hold several."""
        if self._moments.lengths:
            self._moments.add(observation)

    def poll(self, steps: int) -> Array | None:
        """Return the chunk if the thread has it."""
        if not self.running or self._answers.empty():
            return None
        return self.wait()

    def wait(self) -> Array:
        """Return the chunk when the thread has it."""
        answer = self._answers.get()
        self.running = False
        if isinstance(answer, BaseException):
            raise answer
        self.lead_ms = _lead_ms(answer)
        return answer.chunk

    def cancel(self) -> None:
        """Wait for the thread and discard what it answers."""
        if self.running:
            self._answers.get()
            self.running = False
        self._moments.clear()


class _InferenceThread:
    """The thread of a ``BackgroundInference``, which it does not hold; it ends after a None of ``work``."""

    def __init__(self, infer: Callable[..., Any]) -> None:
        self.work: queue.SimpleQueue[Mapping[str, Any] | None] = queue.SimpleQueue()
        self.answers: queue.SimpleQueue[Action | BaseException] = queue.SimpleQueue()
        self.busy = False
        """Whether it infers."""
        self._infer = infer
        self._thread = threading.Thread(target=self._infer_all, name="vlatool-inference", daemon=True)
        self._thread.start()
        close_at_exit(self)

    def _infer_all(self) -> None:
        while (observation := self.work.get()) is not None:
            self.busy = True
            answer: Action | BaseException
            try:
                answer = self._infer(observation)
            except BaseException as error:  # the control loop raises it
                answer = error
            self.busy = False
            self.answers.put(answer)

    def close(self, seconds: float = EXIT_S) -> None:
        """End it after the inference in progress, which is waited for so many seconds."""
        self.work.put(None)
        self._thread.join(seconds)


class Moments:
    """The last observations of an episode, for inputs that hold several moments.

    Args:
        spec: of the policy; ``lengths`` has its inputs with a ``history`` and how many moments they hold.
        inputs: Names of the inputs that are wanted; all when None.
    """

    def __init__(self, spec: PolicySpec, inputs: Collection[str] | None = None) -> None:
        wanted = [tensor for tensor in spec.inputs if inputs is None or tensor.name in inputs]
        self._names = [tensor.name for tensor in wanted]
        self.lengths = {tensor.name: tensor.history for tensor in wanted if tensor.history}
        self._axes = {tensor.name: len(tensor.observation.moment.shape) for tensor in wanted if tensor.history}
        self._before: deque[Mapping[str, Any]] = deque(maxlen=max(self.lengths.values(), default=1))

    def add(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return a copy of an observation in which such inputs hold all their moments, oldest first.

        The first observation stands for those before it. Names that the policy does not take are left out.
        """
        moment = {name: _copied(observation[name]) for name in self._names if name in observation}
        self._before.append({name: moment[name] for name in self.lengths if name in moment})
        return {**moment, **{name: self._window(name) for name in self.lengths if name in moment}}

    def _window(self, name: str) -> Array:
        axes = self._axes[name]
        moments = [np.asarray(each[name]) for each in self._before if name in each][-self.lengths[name] :]
        moments = [each[0] if each.ndim == axes else each for each in moments]
        if len(shapes := {each.shape for each in moments}) > 1:
            raise DataError(f"The moments of '{name}' have different shapes: {sorted(map(list, shapes))}.",
                            "give moments of one shape in an episode")  # fmt: skip
        return np.stack([moments[0]] * (self.lengths[name] - len(moments)) + moments)

    def clear(self) -> None:
        """Start a new episode."""
        self._before.clear()


def _lead_ms(action: Action) -> float | None:
    return None if action.latent_age_ms is None else action.latent_age_ms - action.age_ms


def _copied(value: Any) -> Any:
    return value if isinstance(value, str) else copy.deepcopy(value)
