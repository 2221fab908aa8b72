"""Values of the robot -> values of the network and back, as ``convert`` and ``normalisation`` of a tensor say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.conversion import Conversion, Layout, Span
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError
from vlatool.runtime.assets import Assets
from vlatool.runtime.statistics import load_normaliser

Array = NDArray[Any]
Change = Callable[[Array, "Array | None"], Array]
"""Vectors (..., A), and the state (S,) that an action is relative to -> vectors."""


class _Step(NamedTuple):
    to_network: Change
    to_robot: Change


class Converter:
    """All that lies between the values of the robot and those of the network for one tensor.

    Args:
        tensor: an input, or the action.
        states: of the action: places in it and in the state, for each step ``relative`` in the order of ``convert``.

    Raises:
        SpecError: when statistics are missing or do not fit.
    """

    def __init__(
        self, tensor: TensorSpec, assets: Assets, states: Sequence[tuple[tuple[Span, Span], ...]] = ()
    ) -> None:
        self.normaliser = load_normaliser(tensor, assets)
        self._steps: list[_Step] = []
        remaining, marked = iter(states), False
        for conversion, layout in zip(tensor.convert, tensor.layouts(), strict=False):
            if conversion.op == "normalisation":
                self._steps, marked = [*self._steps, self._normalisation()], True
            elif conversion.op == "relative":
                self._steps.append(_relative(conversion, next(remaining)))
            else:
                self._steps.append(_step(conversion, layout))
        if not marked and self.normaliser is not None:
            self._steps.append(self._normalisation())

    def _normalisation(self) -> _Step:
        normaliser = self.normaliser
        assert normaliser is not None  # the spec has a step 'normalisation' only beside statistics
        return _Step(lambda values, _: normaliser.forward(values), lambda values, _: normaliser.inverse(values))

    def to_network(self, values: Array, state: Array | None = None) -> Array:
        """Return what the network takes.

        Args:
            values: (..., A) floats in the units of the robot, which are not changed; a chunk is (T, A).
            state: (S,) what the action is relative to.

        Raises:
            SpecError: for an action that has a step which cannot be undone.
        """
        for step in self._steps:
            values = step.to_network(values, state)
        return values

    def to_robot(self, values: Array, state: Array | None = None) -> Array:
        """Return what the robot gets; the counterpart of ``to_network``."""
        for step in reversed(self._steps):
            values = step.to_robot(values, state)
        return values


def action_converter(spec: PolicySpec, assets: Assets) -> Converter:
    """Return the converter of a policy's action.

    Raises:
        SpecError: when statistics are missing or do not fit.
    """
    states = [spec.state_spans(step) for step in spec.action.convert if step.op == "relative"]
    return Converter(spec.action, assets, states)


def newest_moment(values: Any, width: int) -> Array:
    """Return the state (S,) of an observation, of its newest moment where it holds several."""
    newest: Array = np.asarray(values, np.float32).reshape(-1, width)[-1]
    return newest


def _step(conversion: Conversion, layout: Layout) -> _Step:
    """Return the functions of a step.

    Args:
        layout: on the side of the robot.
    """
    raise SpecError(f"{conversion.where} is not known to this vlatool.", "upgrade vlatool")


def _places(spans: Sequence[Span]) -> Any:
    """Return what selects the elements of parts: a slice where they lie together, which needs no copy."""
    if len(spans) == 1:
        return slice(*spans[0])
    return np.concatenate([np.arange(start, stop) for start, stop in spans])


def _relative(conversion: Conversion, spans: Sequence[tuple[Span, Span]]) -> _Step:
    """Differences from a state: ``absolute = relative + state``, as LeRobot and openpi have them."""
    mine, theirs = _places([pair[0] for pair in spans]), _places([pair[1] for pair in spans])

    def moved(values: Array, state: Array | None, sign: int) -> Array:
        if state is None:
            raise ValueError("an action that is relative to a state is converted without one")
        out = values.copy()
        part, start = out[..., mine], state[theirs].astype(values.dtype, copy=False)
        if not conversion.successive:
            out[..., mine] = part + start if sign > 0 else part - start
        elif sign > 0:
            out[..., mine] = np.cumsum(part, axis=-2) + start
        else:
            before = np.concatenate([np.broadcast_to(start, part[..., :1, :].shape), part[..., :-1, :]], axis=-2)
            out[..., mine] = part - before
        return out

    return _Step(partial(moved, sign=-1), partial(moved, sign=1))
