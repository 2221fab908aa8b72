"""Values of the robot -> values of the network and back, as ``convert`` and ``normalisation`` of a tensor say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError
from vlatool.runtime.assets import Assets
from vlatool.runtime.statistics import Normaliser, load_normaliser

if TYPE_CHECKING:  # a robot imports what its policy converts
    from vlatool.bundle.conversion import Conversion, Layout, Span

Array = NDArray[Any]
Change = Callable[[Array, "Array | None"], Array]
"""Vectors (..., A), and the state (S,) that an action is relative to -> vectors."""
Elements = Callable[[Array], Array]
"""The elements of a step's parts, (..., K) -> what they become."""


class _Step(NamedTuple):
    to_network: Change
    to_robot: Change


class Converter:
    """All that lies between the values of the robot and those of the network for one tensor.

    Args:
        tensor: an input, or the action.
        states: of the action: places in it and in the state, for each step ``relative`` in the order of ``convert``.
        outward: whether it is the action, which goes from the network to the robot.

    Raises:
        SpecError: when statistics are missing or do not fit.
    """

    def __init__(
        self,
        tensor: TensorSpec,
        assets: Assets,
        states: Sequence[tuple[tuple[Span, Span], ...]] = (),
        *,
        outward: bool = False,
    ) -> None:
        self.normaliser = load_normaliser(tensor, assets)
        self._steps: list[_Step] = []
        remaining, marked = iter(states), False
        layouts = tensor.layouts() if tensor.convert else ()
        for conversion, layout in zip(tensor.convert, layouts, strict=False):
            if conversion.op == "normalisation":
                self._steps, marked = [*self._steps, *_normalisation(self.normaliser)], True
            elif conversion.op == "relative":
                self._steps.append(_relative(conversion, next(remaining)))
            else:
                self._steps.append(_step(conversion, layout, outward))
        if not marked:
            self._steps += _normalisation(self.normaliser)

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
    return Converter(spec.action, assets, states, outward=True)


def newest_moment(values: Any, width: int) -> Array:
    """Return the state (S,) of an observation, of its newest moment where it holds several."""
    newest: Array = np.asarray(values, np.float32).reshape(-1, width)[-1]
    return newest


def _normalisation(normaliser: Normaliser | None) -> list[_Step]:
    if normaliser is None:
        return []
    return [_Step(lambda values, _: normaliser.forward(values), lambda values, _: normaliser.inverse(values))]


def _step(conversion: Conversion, layout: Layout, outward: bool) -> _Step:
    """Return the functions of a step.

    Args:
        layout: on the side of the robot.
    """
    spans = layout.spans(conversion.parts, conversion.where)
    if conversion.op == "rotation":
        return _rotation(conversion, sorted(spans))
    makers: dict[str, Callable[[Conversion], tuple[Elements, Elements]]] = {
        "scale": _scale, "range": _range, "clip": _clip, "linkage": _linkage,
        "binarise": partial(_binarise, outward=outward),
    }  # fmt: skip
    places, changes = _places(spans), makers[conversion.op](conversion)
    return _Step(*(partial(_of_places, places=places, change=change) for change in changes))


def _of_places(values: Array, _: Array | None, places: Any, change: Elements) -> Array:
    out = values.copy()
    out[..., places] = change(out[..., places])
    return out


def _scale(conversion: Conversion) -> tuple[Elements, Elements]:
    factor, offset = np.array(conversion.factor), np.array(conversion.offset)

    def numbers(values: Array) -> tuple[Array, Array]:
        return factor.astype(values.dtype), offset.astype(values.dtype)

    def forward(values: Array) -> Array:
        by, more = numbers(values)
        return np.asarray(values * by + more)

    def backward(values: Array) -> Array:
        by, more = numbers(values)
        return np.asarray((values - more) / by)

    return forward, backward


def _range(conversion: Conversion) -> tuple[Elements, Elements]:
    """One scale on another: by way of 0 to 1, as LeRobot and openpi compute it."""

    def rescale(values: Array, before: Sequence[float], after: Sequence[float]) -> Array:
        shares = (values - before[0]) / (before[1] - before[0])
        return np.asarray(shares * (after[1] - after[0]) + after[0])

    robot, network = (tuple(float(each) for each in side) for side in (conversion.robot, conversion.network))
    return partial(rescale, before=robot, after=network), partial(rescale, before=network, after=robot)


def _clip(conversion: Conversion) -> tuple[Elements, Elements]:
    low, high = np.array(conversion.low or -np.inf), np.array(conversion.high or np.inf)

    def clip(values: Array) -> Array:
        return np.clip(values, low.astype(values.dtype), high.astype(values.dtype))

    return clip, clip


def _binarise(conversion: Conversion, outward: bool) -> tuple[Elements, Elements]:
    equal = conversion.below if conversion.equal is None else conversion.equal

    def binarise(values: Array) -> Array:
        below = np.where(values == conversion.threshold, equal, conversion.below)
        return np.where(values > conversion.threshold, conversion.above, below).astype(values.dtype)

    def refuse(values: Array) -> Array:
        raise SpecError(
            f"{conversion.where} has no way back: what a value was before it, nobody knows.",
            "train on what the network gives (distill), or leave the step out, and let the controller do it",
        )

    return (refuse, binarise) if outward else (binarise, refuse)


def _linkage(conversion: Conversion) -> tuple[Elements, Elements]:
    arm, horn = conversion.arm_length, conversion.horn_radius

    def angles(positions: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            sines = (horn**2 + positions**2 - arm**2) / (2 * horn * positions)
        return np.asarray(np.arcsin(np.clip(sines, -1.0, 1.0)))

    def positions(angles: Array) -> Array:
        roots = np.sqrt(np.maximum(arm**2 - (horn * np.cos(angles)) ** 2, 0))
        return np.asarray(horn * np.sin(angles) + roots)

    return angles, positions


def _rotation(conversion: Conversion, spans: Sequence[Span]) -> _Step:
    from vlatool.runtime.rotation import convert_rotation

    there = [(start + index * conversion.growth, stop + (index + 1) * conversion.growth)
             for index, (start, stop) in enumerate(spans)]  # fmt: skip

    def convert_parts(values: Array, _: Array | None, places: Sequence[Span], forms: tuple[str, str]) -> Array:
        parts, done = [], 0
        for start, stop in places:
            parts += [values[..., done:start], convert_rotation(values[..., start:stop], *forms, conversion.hemisphere)]
            done = stop
        return np.concatenate([*parts, values[..., done:]], axis=-1)

    forms = str(conversion.robot), str(conversion.network)
    return _Step(
        partial(convert_parts, places=spans, forms=forms), partial(convert_parts, places=there, forms=forms[::-1])
    )


def _places(spans: Sequence[Span]) -> Any:
    """Return what selects the elements of parts: a slice where they lie together, which needs no copy."""
    if len(spans) == 1:
        return slice(*spans[0])
    return np.concatenate([np.arange(start, stop) for start, stop in spans])


def _relative(conversion: Conversion, spans: Sequence[tuple[Span, Span]]) -> _Step:
    """Differences from a state: ``absolute = relative + state``, as LeRobot and openpi have them."""
    if conversion.pose:
        return _relative_poses(conversion, spans)
    mine, theirs = _places([pair[0] for pair in spans]), _places([pair[1] for pair in spans])

    def shift(values: Array, state: Array | None, sign: int) -> Array:
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

    return _Step(partial(shift, sign=-1), partial(shift, sign=1))


def _relative_poses(conversion: Conversion, spans: Sequence[tuple[Span, Span]]) -> _Step:
    from vlatool.runtime.pose import absolute_poses, relative_poses

    def compose(values: Array, state: Array | None, change: Callable[..., Array]) -> Array:
        if state is None:
            raise ValueError("an action that is relative to a state is converted without one")
        out = values.copy()
        for mine, theirs in spans:
            part, start = out[..., slice(*mine)], state[slice(*theirs)]
            out[..., slice(*mine)] = change(
                part, start, conversion.pose, conversion.frame, successive=conversion.successive
            )
        return out

    return _Step(partial(compose, change=relative_poses), partial(compose, change=absolute_poses))
