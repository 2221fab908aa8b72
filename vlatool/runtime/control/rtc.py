"""Real-time chunking: infers while it acts, and joins each chunk to what is executed meanwhile."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError
from vlatool.runtime.action_elements import STOPPABLE_MODES
from vlatool.runtime.arguments import check_whole
from vlatool.runtime.control.asynchronous import AsynchronousController
from vlatool.runtime.interface import Array, Policy

LEFT_OVER, DELAY, HORIZON = "prev_chunk_left_over", "inference_delay", "execution_horizon"
"""Inputs of a graph that joins the chunks itself, named as LeRobot names them."""
MAX_BLEND = 10
"""Actions of a seam, when nothing is said: LeRobot's ``execution_horizon``."""
PACED_MODES = ("delta", "velocity", "absolute")
"""Action modes of which it is known how a chunk is executed more slowly."""
ROUNDING = 1e-6


class RealTimeController(AsynchronousController):
    """Asynchronous control without jumps at the seams of chunks (Black, Galliker and Levine 2025, arXiv 2506.07339).

    The actions that are executed during an inference are those of the old chunk, frozen. If the policy has the inputs
    ``prev_chunk_left_over``, ``inference_delay`` and ``execution_horizon``, it is given the rest of the old chunk,
    padded by holding, how many of its actions are expected to be executed during the inference, and how many there
    are; its new chunk is then executed as it is. Otherwise, the first actions of the new chunk are blended with the
    rest of the old one: the share of the new one at the fraction x of the seam is 3 x^2 - 2 x^3, so that the
    actions change no faster where the seam begins and ends than within it.

    If an inference takes more than half of the time that a chunk covers, the chunk would be used up before the next
    one is there. Chunks are then executed more slowly, by interpolation, so that they last (``stretch``).

    Args:
        execute: Number of actions, those left out included, of each chunk before the next inference starts; the
            spec's when 0. It starts earlier if the rest of the chunk is needed to bridge the inference.
        delay: See ``AsynchronousController``.
        memory: See ``AsynchronousController``.
        background: See ``AsynchronousController``.
        blend: Number of actions of a seam; half of a chunk, up to 10, when None.
        stretch: Whether to execute chunks more slowly than the policy's control rate where they would not last.
        clock: See ``ChunkQueue``.

    Raises:
        UsageError: when an argument is not a whole number in its range.
        SpecError: when inputs of the policy for the rest of a chunk do not fit its action.
    """

    def __init__(
        self, policy: Policy, execute: int = 0, *, delay: int = 0, memory: int = 10, background: bool = False,
        blend: int | None = None, stretch: bool = True, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        spec = policy.spec
        check_whole("blend", blend, 0, spec.chunk, optional=True)
        self._guides = _guides(spec)
        self._stretched = stretch and spec.action.kind != "discrete" and spec.action.mode in PACED_MODES
        blend = min(MAX_BLEND, spec.chunk // 2) if blend is None else blend
        mixable = spec.action.kind != "discrete" and spec.action.mode != "relative"  # those of two states differ
        self._blend = blend if mixable else 0
        execute = execute or spec.executed_actions
        super().__init__(policy, execute, delay=delay, memory=memory, background=background, clock=clock)

    def _forget(self) -> None:
        super()._forget()
        self._chunk: Array = np.empty((0, 0), np.float32)

    def _due(self) -> bool:
        bridged = self._steps > 0 and len(self._pending) <= self.expected_delay
        return bridged or super()._due()

    def _begin(self, chunk: Array) -> None:
        before, self._chunk, self._position = self._pending, chunk, self._executed
        if self._stretched:
            self._speed = min(1.0, len(chunk) / max(1, 2 * self.expected_delay))
        self._pending = self._paced(self._position, self._speed)
        if self._last is not None and not self._guides:
            self._join(before, self._last)

    @property
    def _seam(self) -> int:
        """Number of control steps that are blended: no more than until the next chunk is expected."""
        until_next = max(self.expected_delay, math.ceil(self.execute / self._speed))
        return min(math.ceil(self._blend / self._speed), until_next)

    def _join(self, before: list[Array], last: Array) -> None:
        """Blend the actions to come with what would have been executed otherwise.

        Where the old chunk has ended, that is the new one, shifted by the last known difference of the two.
        """
        old, new = last, self._before()
        seam = min(self._seam, len(self._pending))
        for index, action in enumerate(self._pending[:seam]):
            if index < len(before):
                old, new = before[index], action
            fraction = (index + 1) / (seam + 1)
            shifted = self._elements.shift(action, new, old)
            self._pending[index] = self._elements.mix(shifted, action, fraction**2 * (3 - 2 * fraction))

    def _before(self) -> Array:
        """Return what the chunk has for the control step before this one; before its beginning, its first step."""
        if self.policy.spec.action.mode in STOPPABLE_MODES:
            return self._between(max(0.0, self._position - self._speed), self._speed)
        position = self._position - 1
        if position < 0:
            return self._elements.mix(self._chunk[0], self._chunk[min(1, len(self._chunk) - 1)], position)
        return self._between(position, 1.0)

    def _paced(self, start: float, speed: float) -> list[Array]:
        """Return the actions of the chunk from a position in it on, each control step ``speed`` actions farther."""
        if speed == 1 and start == int(start):
            return [np.asarray(row) for row in self._chunk[int(start) :]]
        steps = math.floor((len(self._chunk) - start) / speed + ROUNDING)
        return [self._between(start + step * speed, speed) for step in range(max(0, steps))]

    def _between(self, start: float, speed: float) -> Array:
        """Return the action that takes the robot from a position in the chunk to one ``speed`` farther."""
        elements, last = self._elements, len(self._chunk) - 1
        if self.policy.spec.action.mode in STOPPABLE_MODES:
            middle = min(float(last), max(0.0, start + (speed - 1) / 2))
            index = int(middle + ROUNDING)
            row = elements.mix(self._chunk[index], self._chunk[min(last, index + 1)], max(0.0, middle - index))
            return elements.part(row, speed)
        index = min(last, math.ceil(start + speed - 1 - ROUNDING))
        earlier = self._chunk[index - 1] if index else self._chunk[0] if self._last is None else self._last
        return elements.mix(earlier, self._chunk[index], start + speed - index)

    def _asked(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        if not self._guides:
            return observation
        rest = self._paced(self._position, 1.0)
        frozen = min(len(rest), math.ceil(self.expected_delay * self._speed))
        values: dict[str, Any] = {LEFT_OVER: self._padded(rest), DELAY: frozen, HORIZON: len(rest)}
        names = [tensor.name for tensor in self.policy.spec.inputs if tensor.name in observation]
        given = {tensor.name: _shaped(values[tensor.name], tensor) for tensor in self._guides}
        return {**{name: observation[name] for name in names}, **given}

    def _padded(self, rest: list[Array]) -> Array:
        """Return the rest of a chunk, (T, A), after which the robot holds; zeros without one."""
        spec = self.policy.spec
        last = rest[-1] if rest else self._last
        hold = np.zeros(spec.action.robot_width, np.float32) if last is None else self._elements.hold(last)
        return np.stack([*rest, *[hold] * (spec.chunk - len(rest))])


def _guides(spec: PolicySpec) -> tuple[TensorSpec, ...]:
    """Return the inputs with which a graph joins chunks itself; none where it does not.

    Raises:
        SpecError: when it has a part of them, or the action is not given as the graph had it.
    """
    found = tuple(tensor for tensor in spec.inputs if tensor.name in (LEFT_OVER, DELAY, HORIZON))
    if not found:
        return ()
    names = {tensor.name for tensor in found}
    if not {LEFT_OVER, DELAY} <= names:
        raise SpecError(
            f"The policy takes {', '.join(sorted(names))}; a graph that joins chunks takes {LEFT_OVER} and {DELAY}.",
            "export it with both inputs, or with none of them",
        )
    shape = next(tensor for tensor in found if tensor.name == LEFT_OVER).shape[-2:]
    if spec.reference is not None or spec.action.kind == "discrete" or shape != (spec.chunk, spec.action.robot_width):
        relative = ", relative to a state" if spec.reference else ""
        raise SpecError(
            f"{LEFT_OVER} has the shape {list(shape)}, and the action {spec.chunk} x {spec.action.robot_width}"
            f"{relative}; wanted: continuous actions as the robot gets them, as many as a chunk has.",
            f"declare {LEFT_OVER} with the shape, units and normalisation of the action",
        )
    return found


def _shaped(value: Any, tensor: TensorSpec) -> Array:
    """Return a value as an input that holds as many elements."""
    return np.asarray(value, tensor.dtype).reshape([axis if isinstance(axis, int) else 1 for axis in tensor.shape])
