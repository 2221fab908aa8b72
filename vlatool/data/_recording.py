"""Recorded observations, checked against a spec."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.image import Image
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data._lazy_rows import LazyRows
from vlatool.errors import DataError, suggest
from vlatool.files.printable import amount
from vlatool.files.rows import Rows, blocks, in_memory

Array = NDArray[Any]
Values = Array | Rows
"""An input of all samples: in memory, or on the disk, where it is large."""
RECORD_ALL = "record every input of the spec under its name, a row for each sample"
REPAIR = "remove those samples, or repair the recording"
PADDING = "action_is_pad"
"""Array (N, T): whether an action is there only to fill the chunk, since the episode had ended; as LeRobot names it."""
EXPERT = ("action", "episode", PADDING)
"""Arrays that a recording may hold beside the inputs."""


@dataclass(frozen=True)
class Moment:
    """An observation of a recording, where observations follow each other as they were recorded.

    Args:
        observation: Without the batch axis.
        begins: Whether an episode begins with it.
        counts: Whether it was asked for; what comes before such a one is there for the values that a policy keeps.
    """

    observation: Mapping[str, Any]
    number: int
    begins: bool = False
    counts: bool = True


@dataclass(frozen=True)
class Recording:
    """Observations with, where they were recorded, the expert's actions.

    Args:
        inputs: Input name -> array with a leading sample axis, physical values, text as a unicode array. Large ones
            are rows that stay on the disk.
        actions: (N, T, A) in physical units, or (N, T) indices for discrete actions; T is the policy's chunk, or fewer
            of its leading steps; None when not recorded.
        padded: (N,) whether the episode ends before the chunk does; None where no chunk is longer than its episode.
        episodes: (N,) int64 episode of each sample; None when not recorded.
        times: (N,) float64 time stamp of each sample in seconds; None where the format has none.
        ignored: Names of arrays that the spec does not know.
        chunk: Actions in one inference of the policy.
        whole: Recording that it is a selection of; None when it is all that was recorded.
        indices: (N,) index of each observation in ``whole``.
        left_out: Number of observations that ``with_whole_chunks`` left out.
        histories: Input name -> number of moments in an observation, of inputs of which a sample is one moment.
    """

    path: Path
    inputs: Mapping[str, Values]
    actions: Values | None
    episodes: Array | None
    times: Array | None = None
    ignored: tuple[str, ...] = ()
    chunk: int = 1
    whole: Recording | None = None
    indices: Array | None = None
    padded: Array | None = None
    left_out: int = 0
    histories: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.inputs.values())))

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for index in range(len(self)):
            yield self.observation(index)

    def observation(self, index: int) -> dict[str, Any]:
        """Return one observation without the batch axis; text as ``str``, moments before it from its episode."""
        return {name: self._value(name, index) for name in self.inputs}

    def _value(self, name: str, index: int) -> Any:
        if count := self.histories.get(name):
            whole, at = self.whole or self, index if self.indices is None else int(self.indices[index])
            return whole.inputs[name][whole._last(count, at)]
        value = self.inputs[name][index]
        return str(value) if self.inputs[name].dtype.kind == "U" else value

    def _last(self, count: int, index: int) -> list[int]:
        """Return the indices of the last moments, oldest first; an episode's first one stands for those before it."""
        first = int(self._firsts[np.searchsorted(self._firsts, index, side="right") - 1])
        return [max(first, number) for number in range(index - count + 1, index + 1)]

    @functools.cached_property
    def _firsts(self) -> NDArray[np.intp]:
        """Index of the first observation of each episode."""
        return np.flatnonzero(self.begins())

    def subset(self, chosen: NDArray[np.bool_]) -> Recording:
        """Return some observations, in their order."""
        inputs = {name: _selected(values, chosen) for name, values in self.inputs.items()}
        actions = None if self.actions is None else _selected(self.actions, chosen)
        episodes = None if self.episodes is None else self.episodes[chosen]
        times = None if self.times is None else self.times[chosen]
        padded = None if self.padded is None else self.padded[chosen]
        indices = np.flatnonzero(chosen) if self.indices is None else self.indices[chosen]
        series = replace(self, inputs=inputs, actions=actions, episodes=episodes, times=times, padded=padded)
        return replace(series, whole=self.whole or self, indices=indices)

    def with_whole_chunks(self) -> Recording:
        """Return the observations that can be judged: those whose expert acts until the end of the chunk.

        Raises:
            DataError: when there are none.
        """
        if self.actions is None or self.padded is None or not self.padded.any():
            return self
        if self.padded.all():
            raise DataError(
                f"No observation of {self.path} is followed by {self.actions.shape[1]} actions of its episode.",
                "record longer episodes",
            )
        return replace(self.subset(~self.padded), left_out=int(self.padded.sum()))

    def begins(self) -> NDArray[np.bool_]:
        """Say of each observation whether an episode begins with it, or none follows the one before: (N,)."""
        numbers = np.zeros(len(self), np.int64) if self.episodes is None else self.episodes
        indices = np.arange(len(self)) if self.indices is None else self.indices
        return np.concatenate([[True], (numbers[1:] != numbers[:-1]) | (np.diff(indices) != 1)])

    def with_history(self, numbers: Sequence[int]) -> Iterator[Moment]:
        """Yield observations, each after those of its episode that were recorded before it, held out or not.

        Args:
            numbers: Indices of those that count, ascending.
        """
        whole = self.whole or self
        own = {int(number if self.indices is None else self.indices[number]): int(number) for number in numbers}
        begins = whole.begins()
        firsts = whole._firsts
        last = {int(np.searchsorted(firsts, index, side="right")): index for index in own}
        for episode, end in last.items():
            for index in range(int(firsts[episode - 1]), end + 1):
                yield Moment(whole.observation(index), own.get(index, index), bool(begins[index]), index in own)

    @property
    def unjudged_steps(self) -> tuple[str, ...]:
        """Sentences on what is not judged: steps that are not recorded, observations without a whole chunk."""
        sentences = []
        if self.actions is not None and (steps := self.actions.shape[1]) != self.chunk:
            some = "the first one alone is" if steps == 1 else f"the first {steps} alone are"
            sentences.append(
                f"{self.path.name} records {steps} of the {self.chunk} actions of each chunk: {some} held against the "
                f"expert; record all {self.chunk} that follow each observation to judge the whole chunk"
            )
        if self.left_out:
            sentences.append(
                f"{self.left_out} of {self.left_out + len(self)} observations of {self.path.name} are not judged: "
                "their episode ends before the chunk does"
            )
        return tuple(sentences)

    def spread(self, count: int) -> list[int]:
        """Return ``count`` indices (or all) spread evenly over the recording, so that every phase is present."""
        if count >= len(self):
            return list(range(len(self)))
        return sorted({int(index) for index in np.linspace(0, len(self) - 1, count)})


def _selected(values: Values, chosen: NDArray[np.bool_]) -> Values:
    return values.select(chosen) if isinstance(values, Rows) else values[chosen]


def build_recording(
    path: Path, arrays: Mapping[str, Values], spec: PolicySpec, names: Mapping[str, str], times: Array | None = None
) -> Recording:
    """Build a recording from arrays, each checked against the spec.

    Args:
        arrays: Name -> array with a leading sample axis; actions as ``action`` or under their name, and ``episode``.
        names: Name in the spec -> name among the arrays, where they differ.
        times: (N,) float64 time stamps in seconds; None where the format has none.

    Raises:
        DataError: naming the input and the sample.
    """
    wanted = {recorded: name for name, recorded in names.items()}
    arrays = {wanted.get(name, name): values for name, values in arrays.items()}
    inputs = {}
    for tensor in spec.inputs:
        if tensor.name not in arrays:
            raise DataError(f"{path} has no '{tensor.name}'; {suggest(tensor.name, arrays)}.", RECORD_ALL)
        observed = _any_size(tensor.moment)
        inputs[tensor.name] = _checked_input(path, observed, arrays[tensor.name], spec)
        if tensor.image is not None:
            _check_frames(f"'{tensor.name}' in {path}", tensor, tensor.image, inputs[tensor.name])
    actions, episodes = _in_memory(arrays, spec.action.name, "action"), _in_memory(arrays, "episode")
    padded = _in_memory(arrays, PADDING)
    lengths = {name: len(values) for name, values in inputs.items()}
    for name, recorded in (("action", actions), ("episode", episodes), (PADDING, padded), ("times", times)):
        if recorded is not None:
            lengths[name] = _length(path, name, recorded)
    if len(set(lengths.values())) != 1:
        raise DataError(f"{path} has different numbers of samples: {lengths}.", "each array needs one row a sample")
    if not next(iter(lengths.values())):
        raise DataError(f"{path} holds no samples.", RECORD_ALL)
    if episodes is not None and episodes.dtype.kind not in "iu":
        raise DataError(
            f"'episode' in {path} is {episodes.dtype}; wanted whole numbers.",
            "store the number of the episode that each sample is of, as int64",
        )
    known = {*inputs, *EXPERT, *(tensor.name for tensor in spec.outputs)}
    ignored = tuple(name for name in arrays if name not in known)
    action = None if actions is None else _checked_action(path, spec, actions)
    histories = {tensor.name: tensor.history for tensor in spec.inputs if tensor.history}
    whole = _checked_padding(path, padded)
    return Recording(path, inputs, action, episodes, times, ignored, spec.chunk, padded=whole, histories=histories)


def _checked_padding(path: Path, values: Array | None) -> Array | None:
    """Return for each sample whether a part of its chunk is padding."""
    if values is not None and values.dtype != np.bool_:
        raise DataError(
            f"'{PADDING}' in {path} is {values.dtype}; wanted truth values.",
            "store for each action of a chunk whether it only fills the chunk, as bool",
        )
    return None if values is None else np.asarray(values.reshape(len(values), -1).any(axis=1))


def _in_memory(arrays: Mapping[str, Values], *names: str) -> Array | None:
    """Return the first array that there is, in memory: actions and episodes are compared as a whole."""
    array = next((arrays[name] for name in names if name in arrays), None)
    return None if array is None else in_memory(array)


def _length(path: Path, name: str, values: Values) -> int:
    if not values.ndim:
        raise DataError(
            f"'{name}' in {path} is a single value; wanted one row a sample.", "store it with a first axis of samples"
        )
    return len(values)


def _checked_input(path: Path, tensor: TensorSpec, values: Values, spec: PolicySpec) -> Values:
    where = f"'{tensor.name}' in {path}"
    if tensor.kind == "text":
        if values.dtype.kind != "U":
            raise DataError(
                f"{where} is {values.dtype}; a text input needs unicode strings.",
                "store it with np.array(TEXTS), a str for each sample",
            )
        if values.size != _length(path, tensor.name, values):
            raise DataError(
                f"{where} has the shape {list(values.shape)}; a text input has one string a sample.",
                "store a one-dimensional array, a str for each sample",
            )
        return values if isinstance(values, Rows) else values.reshape(-1)
    if values.ndim == max(1, len(tensor.shape)) + 1 and values.shape[1] == 1:
        values = values.without_second_axis() if isinstance(values, Rows) else values[:, 0]
    if not _fits(tensor, values):
        others = [one.name for one in spec.inputs if one.kind != "text" and _fits(_any_size(one.moment), values)]
        raise DataError(
            f"{where} has the shape {list(values.shape)}; wanted [N, {', '.join(map(str, tensor.shape[1:]))}].",
            f"it would fit '{others[0]}'; are the names swapped?" if others else RECORD_ALL,
        )
    _check_type(where, tensor, values)
    if isinstance(values, LazyRows):  # each row is checked when it is read
        return values.within(np.dtype(tensor.dtype)) if tensor.finite and values.dtype.kind == "f" else values
    if tensor.finite:
        _check_finite(where, values, f"{REPAIR}; where the policy handles them: finite: false in its spec")
    return values


def _any_size(tensor: TensorSpec) -> TensorSpec:
    """Return an input as recordings have it: before it is converted; frames of any size, where it is an image."""
    observed = tensor.observation
    if tensor.image is None:
        return observed
    return replace(observed, shape=(1, "height", "width", *observed.shape[3:]))


def _check_frames(where: str, tensor: TensorSpec, image: Image, values: Values) -> None:
    """Refuse frames of a size of which no input can be made."""
    height, width = values.shape[1:3]
    if not image.makes((height, width), tensor.shape):
        raise DataError(
            f"{where} has frames of {height}x{width}, of which its image makes no input {list(tensor.shape)}.",
            "let the image in the spec resize them (a step {op: resize, size: [HEIGHT, WIDTH]}), or record others",
        )


def _fits(tensor: TensorSpec, values: Values) -> bool:
    expected = tensor.shape[1:]
    return values.ndim == len(expected) + 1 and all(
        isinstance(want, str) or want == got for want, got in zip(expected, values.shape[1:], strict=True)
    )


def _check_type(where: str, tensor: TensorSpec, values: Values) -> None:
    """Refuse a type that the runtime would refuse, and numbers that the policy's type cannot hold."""
    expected, got = np.dtype(tensor.dtype), values.dtype
    numbers = got == expected or (got.kind in "iu" and expected.kind in "iu" and np.can_cast(got, expected))
    if expected.kind == "f":
        numbers = got.kind in "iuf"
    if not numbers:
        hint = "store raw pixel values from 0 to 255" if tensor.dtype == "uint8" else f"store it as {tensor.dtype}"
        raise DataError(f"{where} is {values.dtype}; the policy takes {tensor.dtype}.", hint)
    wider = values.dtype.kind == "f" and values.dtype.itemsize > expected.itemsize
    if expected.kind == "f" and wider and not isinstance(values, LazyRows):
        _check_size(where, tensor, values)


def _check_size(where: str, tensor: TensorSpec, values: Values) -> None:
    """Refuse numbers beyond what the policy's type can hold."""
    limit = float(np.finfo(np.dtype(tensor.dtype)).max)
    for start, block in blocks(values):
        beyond = np.isfinite(block) & (np.abs(block) > limit)
        if beyond.any():
            first = start + int(np.flatnonzero(beyond.reshape(len(block), -1).any(axis=1))[0])
            raise DataError(
                f"{where} exceeds {tensor.dtype} in sample {first}: {float(block[beyond][0]):g}; allowed: {limit:g}.",
                "repair the recording",
            )


def _checked_action(path: Path, spec: PolicySpec, values: Array) -> Array:
    """Return the expert's actions as (N, T, A), or (N, T) indices, of which T is no more than the chunk."""
    where, action = f"the expert's action in {path}", spec.action
    if action.kind == "discrete":
        values = _indices(where, values.reshape(len(values), -1), len(action.labels))
    else:
        values = _numbers(where, values, spec)
    if not 1 <= values.shape[1] <= spec.chunk:
        raise DataError(
            f"{where} has {values.shape[1]} steps in each sample; allowed: 1 to {spec.chunk}, the policy's chunk.",
            "record for each observation the actions that follow it, as many as the policy gives or the first of them",
        )
    return values


def _numbers(where: str, values: Array, spec: PolicySpec) -> Array:
    width, got = spec.action.robot_width, list(values.shape)
    if values.dtype.kind not in "iuf":
        raise DataError(f"{where} is {values.dtype}; wanted numbers in physical units.", "store it as float32")
    if values.ndim < 2 or got[-1] != width:
        last = got[-1] if values.ndim > 1 else 1
        raise DataError(
            f"{where} has {last} elements; the policy gives {width}.",
            f"store [N, {spec.chunk}, {width}], or [N, {width}] for the first action alone; got {got}",
        )
    _check_finite(where, values, REPAIR)
    return values.reshape(len(values), math.prod(got[1:-1]), width)


def _indices(where: str, values: Array, labels: int) -> Array:
    if values.dtype.kind not in "iu":
        raise DataError(
            f"{where} must be indices from 0 to {labels - 1}; got {values.dtype}.",
            "store the index of each action in the spec's labels, as int64",
        )
    wrong = (values < 0) | (values >= labels)
    if wrong.any():
        sample, step = (int(index) for index in np.argwhere(wrong)[0])
        raise DataError(
            f"{where} must be indices from 0 to {labels - 1}; got {int(values[sample, step])} in sample {sample}"
            f" (and in {int(wrong.any(axis=1).sum())} of {amount(len(values), 'sample')} such a value).",
            "store the index of each action in the spec's labels",
        )
    return values


def _check_finite(where: str, values: Values, fix: str) -> None:
    if values.dtype.kind != "f":
        return
    bad: list[int] = []
    for start, block in blocks(values):
        if not np.isfinite(block).all():
            wrong = ~np.isfinite(block.reshape(len(block), -1)).all(axis=1)
            bad += (start + np.flatnonzero(wrong)).tolist()
    if bad:
        raise DataError(
            f"{where} is not finite in {len(bad)} of {amount(len(values), 'sample')}; the first is sample {bad[0]}.",
            fix,
        )
