"""Causes of a difference between actions: the compared stages, or else the changes that would make both equal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import VlatoolError
from vlatool.runtime.interface import Array
from vlatool.runtime.policy import Policy
from vlatool.verify._sample import Sample

Change = Callable[[Sample], Mapping[str, Array]]
MAX_TRIED = 6
"""Observations on which a guess must make both equal."""
MIN_FIT_VALUES = 16
"""Values of an element from which a straight line through them says something."""
MAX_RESIDUAL = 0.1
"""Share of a difference that a straight line may leave and still explain it: through mere rounding it leaves most."""
NARROW = {"float16": (2.0**-11, 2.0**-25), "bfloat16": (2.0**-8, 2.0**-133)}
"""Dtype -> the relative and the least absolute rounding."""


def causes(
    policy: Policy, samples: Sequence[Sample], stages: Sequence[Mapping[str, Any]], tolerance: float
) -> tuple[list[str], bool]:
    """Return what differs, a sentence for each cause, and whether the stage is certain."""
    known = list(_of_quantization(policy))
    certain = list(_of_rounding(policy, samples)) or list(_of_stages(policy, samples, stages, tolerance))
    if certain:
        return [*known, *certain], True
    guesses = [*_of_action(policy, samples, tolerance), *_of_inputs(policy, samples, tolerance)]
    if guesses:
        return [*known, *guesses], True
    text = [*known, *_of_texts(policy, samples, tolerance)]
    where = "no single change of an input or of the action makes both equal, so it is the network (weights, layers, "
    where += "eval mode, the order of the inputs), or more than one stage"
    return [*text, f"Which stage differs is not certain: {where}."], False


def _of_quantization(policy: Policy) -> Iterator[str]:
    """Say when the policy is not the float32 one, which differs from its original by design."""
    graphs = policy.bundle.manifest.graphs.values()
    kinds = dict.fromkeys(kind for graph in graphs for kind in (*graph.precision, graph.compute))
    lower = [kind for kind in kinds if kind not in ("", "float32", "float64")]
    if lower:
        yield (
            f"This bundle is in {' and '.join(lower)}, which alone makes its actions differ: compare the float32 "
            "bundle that it was made from, or pass a --tolerance that allows what it costs."
        )


def _of_rounding(policy: Policy, samples: Sequence[Sample]) -> Iterator[str]:
    """Say when the original's action is this policy's, rounded to a narrower dtype."""
    if policy.spec.action.kind == "discrete":
        return
    mine = np.concatenate([sample.chunk for sample in samples])
    theirs = np.concatenate([sample.expected for sample in samples])
    for dtype, (relative, least) in NARROW.items():
        within = np.abs(mine - theirs) <= 1.1 * np.maximum(relative * np.abs(mine), least)
        if within.all() and np.array_equal(_round_to(theirs, dtype), theirs):
            yield (
                f"The original's action is in {dtype}, and the difference is that rounding: let it return float32, or "
                "pass a --tolerance that allows it."
            )
            return


def _round_to(values: Array, dtype: str) -> Array:
    """Return the values as that dtype holds them; bfloat16 is float32 without its lower 16 bits."""
    if dtype == "float16":
        with np.errstate(over="ignore"):
            return values.astype(np.float16).astype(values.dtype)
    bits = values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF0000)
    return bits.view(np.float32).astype(values.dtype)


def _of_stages(
    policy: Policy, samples: Sequence[Sample], stages: Sequence[Mapping[str, Any]], tolerance: float
) -> Iterator[str]:
    """Say what the stages tell that could be compared."""
    before = [stage for stage in stages if stage["input"]]
    wrong = [stage for stage in before if stage["differs"]]
    for stage in wrong:
        yield f"The {stage['stage']} differs, first on observation {stage['first']}" + _by(samples, stage) + "."
    network = next((stage for stage in stages if stage["stage"] == "network"), None)
    if wrong:
        if _equal(policy, samples, lambda sample: {**sample.encoded, **sample.inputs}, tolerance):
            yield "With the original's inputs this policy gives the original's actions: nothing else differs."
        return
    if network is not None and not network["differs"]:
        yield "The network gives the same, so the denormalisation differs: look at the action's statistics and units."
    elif network is not None:
        compared = [stage["input"] for stage in before]
        others = [tensor.name for tensor in policy.spec.inputs if tensor.name not in compared]
        guessed = list(_of_inputs(policy, samples, tolerance)) if others else []
        yield from guessed
        if guessed or not before:
            return
        are = "is" if len(compared) == 1 else "are"
        those = "The inputs are" if not others else f"Of the inputs, {_quoted_names(compared)} {are}"
        words = f"{those} the same, the network's output is not, first on observation {network['first']}"
        if any(_of_quantization(policy)):
            yield f"{words}, as is to be expected."
            return
        words += ": look at weights, layers, eval mode, and the order in which forward() takes the inputs"
        yield words + (f", and at {_quoted_names(others)}, which preprocess() does not return." if others else ".")


def _quoted_names(names: Sequence[str]) -> str:
    return " and ".join(", ".join(f"'{name}'" for name in part) for part in (names[:-1], names[-1:]) if part)


def _by(samples: Sequence[Sample], stage: Mapping[str, Any]) -> str:
    """Return what both have there, of an input that differs."""
    sample = next(entry for entry in samples if entry.number == stage["first"])
    mine, theirs = sample.encoded[stage["input"]], sample.inputs[stage["input"]]
    if mine.shape != theirs.shape:
        return f": {list(mine.shape)} here, {list(theirs.shape)} in the original"
    index = np.unravel_index(int(np.abs(mine.astype(np.float64) - theirs).argmax()), mine.shape)
    return f": {mine[index]:.6g} here, {theirs[index]:.6g} in the original, at {[int(entry) for entry in index[1:]]}"


def _of_action(policy: Policy, samples: Sequence[Sample], tolerance: float) -> Iterator[str]:
    """Try what a wrong denormalisation would do."""
    if policy.spec.action.kind == "discrete":
        return
    action = policy.spec.action
    if (
        action.normalisation != "none"
        and action.width == samples[0].expected.shape[1]
        and all(
            policy.chunk_error(
                sample.raw.reshape(-1, sample.expected.shape[1])[: len(sample.expected)], sample.expected
            )
            <= tolerance
            for sample in samples
        )
    ):
        yield "The denormalisation differs: the original gives the network's output as it is, still normalised."
        return
    yield from _of_lines(policy, samples, tolerance)


def _of_lines(policy: Policy, samples: Sequence[Sample], tolerance: float) -> Iterator[str]:
    """Fit the original's elements as straight lines of this policy's: a difference in scale or offset alone."""
    mine = np.concatenate([sample.chunk for sample in samples])
    theirs = np.concatenate([sample.expected for sample in samples])
    if len(mine) < MIN_FIT_VALUES:
        return
    labels = policy.spec.action.labels or tuple(map(str, range(mine.shape[1])))
    lines = []
    for index, label in enumerate(labels):
        spread = float(mine[:, index].std())
        if not spread:
            if np.array_equal(mine[:, index], theirs[:, index]):
                continue
            return
        slope, offset = np.polyfit(mine[:, index], theirs[:, index], 1)
        left = slope * mine[:, index] + offset - theirs[:, index]
        if not np.abs(left).max() <= 10 * tolerance * float(theirs[:, index].std()):
            return
        if abs(slope - 1) > tolerance or abs(offset) > tolerance * spread:
            if not left.std() <= MAX_RESIDUAL * np.sqrt(np.mean((theirs - mine)[:, index] ** 2)):
                return
            lines.append(f"the original's {label} is {slope:.4g} times this policy's plus {offset:.4g}")
    if lines:
        yield f"The denormalisation differs (statistics, units or order of the elements): {'; '.join(lines[:6])}."


def _of_inputs(policy: Policy, samples: Sequence[Sample], tolerance: float) -> Iterator[str]:
    """Try what a wrong preprocessing of a single input would do."""
    for words, change in _changes(policy):
        if _equal(policy, samples, change, tolerance):
            yield words


def _changes(policy: Policy) -> Iterator[tuple[str, Change]]:
    """Yield a cause, and what the network would take if it were so."""
    inputs = policy.spec.inputs
    for tensor in inputs:
        name = tensor.name
        if tensor.kind != "text" and tensor.normalisation != "none" and not tensor.convert:
            words = f"The normalisation of '{name}' differs: the original takes it as it is, this policy with "
            yield words + f"{tensor.normalisation}.", _as_it_is(name)
        axis = _channels_axis(tensor)
        if axis is not None:
            words = f"The channels of '{name}' differ: with red and blue exchanged both are equal."
            yield words, _mirror(name, axis)
    for index, one in enumerate(inputs):
        for other in inputs[index + 1 :]:
            if (one.shape, one.dtype) == (other.shape, other.dtype):
                words = f"The inputs '{one.name}' and '{other.name}' are exchanged."
                yield words, _exchange(one.name, other.name)


def _as_it_is(name: str) -> Change:
    return lambda sample: {**sample.encoded, name: _physical(sample, name)}


def _channels_axis(tensor: TensorSpec) -> int | None:
    """Return the axis of an image's three channels, None where it has none."""
    if tensor.image is not None:
        return len(tensor.shape) - 3 + tensor.image.layout.index("c") if len(tensor.image.channels) == 3 else None
    return len(tensor.shape) - 1 if tensor.dtype == "uint8" and tensor.width == 3 else None


def _mirror(name: str, axis: int) -> Change:
    return lambda sample: {**sample.encoded, name: np.ascontiguousarray(np.flip(sample.encoded[name], axis))}


def _exchange(one: str, other: str) -> Change:
    return lambda sample: {**sample.encoded, one: sample.encoded[other], other: sample.encoded[one]}


def _physical(sample: Sample, name: str) -> Array:
    encoded = sample.encoded[name]
    return np.asarray(sample.observation[name], encoded.dtype).reshape(encoded.shape)


def _equal(policy: Policy, samples: Sequence[Sample], change: Change, tolerance: float) -> bool:
    """Say whether both are equal when the network takes other inputs; only what forgets can be asked twice."""
    from vlatool.verify._sample import error_of

    if policy.program.keeps:
        return False
    differing = [sample for sample in samples if not sample.error <= tolerance]
    chosen = [*differing[:MAX_TRIED], *samples[:MAX_TRIED]]
    for sample in chosen:
        try:
            values = policy.program.run({name: value.copy() for name, value in change(sample).items()}, sample.noise)
            chunk = policy.decode(values[policy.spec.action.name], sample.encoded)
        except VlatoolError:
            return False
        if (
            not error_of(policy, chunk.astype(sample.expected.dtype)[: len(sample.expected)], sample.expected)
            <= tolerance
        ):
            return False
    return True


def _of_texts(policy: Policy, samples: Sequence[Sample], tolerance: float) -> Iterator[str]:
    """Say when the difference depends on the text alone."""
    for tensor in policy.spec.inputs:
        if tensor.kind != "text":
            continue
        wrong = {str(sample.observation[tensor.name]) for sample in samples if not sample.error <= tolerance}
        right = {str(sample.observation[tensor.name]) for sample in samples if sample.error <= tolerance}
        if right and not wrong & right:
            first = min(wrong)
            yield (
                f"The tokenizer of '{tensor.name}' seems to differ: {len(wrong)} texts differ always and {len(right)} "
                f"never; the first is {first[:60]!r}."
            )
