"""Which element of an input moves which element of the action: central finite differences at recorded observations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.data import recorded_observations, synthetic_observations
from vlatool.errors import BundleError
from vlatool.runtime.identity import policy_identity
from vlatool.runtime.interface import Array
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import draw
from vlatool.runtime.statistics import load_normaliser
from vlatool.verify._images import channel_axis, is_image

STEP = 0.1
"""Step of a finite difference, in spreads of the element."""
MAX_ELEMENTS = 64
"""Elements of an input that are moved one by one; an input of more is left out."""
COLOURS = ("red", "green", "blue", "alpha")


@dataclass(frozen=True)
class Influence:
    """How an element of an input moves an element of the first action of a chunk.

    Args:
        input: name of the input and its element, ``proprio.x``; of an image, a colour of all of its pixels.
        output: label of the action's element; of a discrete action, the logit.
        slope: mean change of the output for a change of the input by one unit.
        unit: unit of the slope.
        effect: change of the output in its spreads when the input changes by one of its spreads, with the slope's sign.
        agreement: share of the observations in which the slope has the sign of the mean, 0-1.
    """

    input: str
    output: str
    slope: float
    unit: str
    effect: float
    agreement: float


@dataclass(frozen=True)
class Element:
    """An element of an input that can be moved.

    Args:
        where: index of it in the input without the batch axis.
        spread: training deviation, or that of the observations, in ``unit``.
    """

    tensor: TensorSpec
    label: str
    where: tuple[Any, ...]
    spread: float
    unit: str


def sensitivity(bundle: Bundle, samples: int) -> dict[str, Any]:
    """Return the influences of a bundle's inputs on its action, the largest first, as JSON values.

    Args:
        samples: recorded observations at most, spread over the calibration recording; random ones without any.

    Raises:
        BundleError: when the bundle has no graph.
        DataError: when the recording cannot be read.
    """
    if not bundle.manifest.graphs:
        raise BundleError(f"{bundle.path} has no graph to run.", "export it first: vlatool export SOURCE -o BUNDLE")
    recorded = recorded_observations(bundle, samples)
    observations = list(recorded) or synthetic_observations(bundle, samples)
    policy = Policy.open(bundle, threads=1, seed=0)
    found = sorted(influences(policy, observations), key=lambda each: -abs(each.effect))
    moved = {each.input.partition(".")[0] for each in found}
    left_out = [tensor.name for tensor in policy.spec.inputs if tensor.name not in moved]
    return {
        "identity": policy_identity(bundle), "samples": len(observations), "recorded": bool(len(recorded)),
        "left_out": left_out, "influences": [asdict(each) for each in found],
    }  # fmt: skip


def influences(policy: Policy, observations: Sequence[Mapping[str, Any]]) -> list[Influence]:
    """Return the influence of every element that can be moved on every element of the first action."""
    random = np.random.default_rng(0)
    noise = {name: draw(expected, random) for step in policy.program.steps for name, expected in step.noise.items()}
    base = np.stack([_output(policy, observation, noise) for observation in observations])
    spreads = _output_spreads(policy, base)
    return [
        influence
        for tensor in (each.observation for each in policy.spec.inputs)
        for element in elements_of(policy, tensor, observations)
        for influence in _of_element(policy, element, observations, noise, spreads)
    ]


def elements_of(policy: Policy, tensor: TensorSpec, observations: Sequence[Mapping[str, Any]]) -> Iterator[Element]:
    """Yield the elements of an input: numbers of floats, colours of images, none of text and of integers."""
    if tensor.kind == "text" or (np.dtype(tensor.dtype).kind != "f" and not is_image(tensor)):
        return
    values = np.stack([np.asarray(observation[tensor.name], np.float64) for observation in observations])
    if is_image(tensor):
        axis = channel_axis(tensor)
        for index in range(values.shape[axis]):
            where = (..., index) if axis == -1 else (..., index, slice(None), slice(None))
            unit = "level" if tensor.dtype == "uint8" else tensor.units()[0] if tensor.units() else ""
            yield Element(tensor, COLOURS[index], where, float(values[(slice(None), *where)].std()) or 1.0, unit)
        return
    shape = values.shape[1:]
    if int(np.prod(shape)) > MAX_ELEMENTS:
        return
    normaliser = load_normaliser(tensor, policy.bundle)
    scale = values.std(axis=0) if normaliser is None else np.broadcast_to(normaliser.scale, shape)
    for at in np.ndindex(shape):
        label = tensor.labels[at[-1]] if at and tensor.labels else str(at[-1] if at else 0)
        label = f"{label}[{', '.join(map(str, at[:-1]))}]" if len(at) > 1 else label
        unit = tensor.units()[at[-1]] if at and tensor.units() else str(tensor.unit or "")
        yield Element(tensor, label, at, float(scale[at]) or 1.0, unit)


def _of_element(
    policy: Policy,
    element: Element,
    observations: Sequence[Mapping[str, Any]],
    noise: Mapping[str, Array],
    spreads: NDArray[np.float64],
) -> Iterator[Influence]:
    slopes = np.stack([_slope(policy, element, observation, noise) for observation in observations])
    means = slopes.mean(axis=0)
    action = policy.spec.action
    units = [""] * len(means) if action.kind == "discrete" else list(action.units() or [""] * len(means))
    for index, mean in enumerate(means.tolist()):
        label = action.labels[index] if action.labels else str(index)
        agreement = float(np.mean(np.sign(slopes[:, index]) == np.sign(mean)))
        unit = f"{units[index] or '1'}/{element.unit or '1'}"
        effect = mean * element.spread / float(spreads[index])
        yield Influence(f"{element.tensor.name}.{element.label}", label, mean, unit, effect, agreement)


def _slope(
    policy: Policy, element: Element, observation: Mapping[str, Any], noise: Mapping[str, Array]
) -> NDArray[np.float64]:
    """Return the change of the first action for a change of the element by one unit: (A,)."""
    outputs, distance = [], 0.0
    for sign in (1, -1):
        values = np.array(observation[element.tensor.name], np.float64)
        before = values[element.where].mean()
        values[element.where] += sign * STEP * element.spread
        if element.tensor.dtype == "uint8":
            values = np.clip(np.round(values), 0, 255)
        distance += sign * float(values[element.where].mean() - before)
        moved = values.astype(element.tensor.dtype)
        outputs.append(_output(policy, {**observation, element.tensor.name: moved}, noise))
    change: NDArray[np.float64] = (outputs[0] - outputs[1]) / (distance or 1.0)
    return change


def _output(policy: Policy, observation: Mapping[str, Any], noise: Mapping[str, Array]) -> NDArray[np.float64]:
    """Return the first action of a new episode, or the logits of a discrete one: (A,) float64."""
    policy.reset(0)
    action = policy.infer(observation, noise=noise)
    first = action.chunk
    if policy.spec.action.kind == "discrete":
        logits = action.outputs[policy.spec.action.name]
        first = logits.reshape(-1, logits.shape[-1])
    values: NDArray[np.float64] = first[0].astype(np.float64)
    return values


def _output_spreads(policy: Policy, base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the training deviation of each element of the action; that over the observations where not known."""
    action = policy.spec.action
    normaliser = None if action.kind == "discrete" else load_normaliser(action, policy.bundle)
    known = normaliser is not None and not action.convert
    spread = normaliser.scale.astype(np.float64) if normaliser is not None and known else base.std(axis=0)
    return np.where(spread > 0, spread, 1.0)
