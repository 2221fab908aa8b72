"""Signals of a recording, read for comparison with those of other episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.data import Recording
from vlatool.files.rows import Rows, in_memory
from vlatool.verify._images import is_image
from vlatool.verify._series import Array, Indices, Motion, Series, blocks
from vlatool.verify._views import PLACES

MAX_ROWS = 4000
"""Rows of a reference that are read: of whole episodes, spread over it."""
MIN_GROUPS = 3
STEP_NOISE, GREY_NOISE = 1.0, 0.01
"""Noise that a right log may have beyond the reference's: of a control step's size, and of the brightest block."""
SHIFT = (0, 1)
"""Blocks by which a camera may see all elsewhere: up or down, and sideways."""
SAME_ACTION = 0.1
"""Share of the largest difference of actions that two of the same moment have at most."""
MAX_CODES = 64
"""Values of an input of integers, above which it does not number something."""
WHOLE = 8
"""Parts into which a recording without episodes is divided."""
Changes = Mapping[str, tuple[str, Callable[[Array], Array]]]
"""Image -> the input of the log that shows it, and what makes that right."""


@dataclass(frozen=True)
class Names:
    """Which signals there are: vectors of floats, images, and the commands; empty without.

    Args:
        codes: inputs of integers, where the commands are integers, too.
        dense: whether rows follow each other by a control step: without that, nothing follows from anything in time.
    """

    vectors: tuple[str, ...]
    images: tuple[str, ...]
    commands: str
    dense: bool = True
    codes: tuple[str, ...] = ()


def names_of(spec: PolicySpec, log: Recording, reference: Recording, width: int) -> Names:
    """Return the signals that both recordings have."""
    vectors, images = [], []
    for tensor in (each.observation for each in spec.inputs):
        one, other = log.inputs[tensor.name], reference.inputs[tensor.name]
        if tensor.kind == "text" or one.shape[1:] != other.shape[1:]:
            continue
        if is_image(tensor):
            images.append(tensor.name)
        elif np.dtype(tensor.dtype).kind == "f" and int(np.prod(one.shape[1:])) <= width:
            vectors.append(tensor.name)
    both = log.actions is not None and reference.actions is not None
    dense = all(is_dense(each, spec) for each in (log, reference))
    commands = spec.action.name if both else ""
    found = _codes(spec, log, reference, width) if commands and spec.action.kind == "discrete" else ()
    return Names(tuple(vectors), tuple(images), commands, dense, tuple(found))


def _codes(spec: PolicySpec, log: Recording, reference: Recording, width: int) -> Iterator[str]:
    for tensor in spec.inputs:
        mine, other = log.inputs[tensor.name], reference.inputs[tensor.name]
        integers = tensor.kind != "text" and not is_image(tensor) and np.dtype(tensor.dtype).kind in "iu"
        if integers and mine.shape[1:] == other.shape[1:] and int(np.prod(mine.shape[1:])) <= width:
            yield tensor.name


def is_dense(recording: Recording, spec: PolicySpec) -> bool:
    """Return whether each row is a control step after the one before, as far as its chunk of actions tells.

    Where rows are steps apart, the first action of a row is in the chunk of the one before not the second, but a later.
    """
    if recording.actions is None or recording.actions.shape[1] < 3 or spec.action.kind == "discrete":
        return True
    actions = in_memory(recording.actions).astype(np.float64)
    follows = ~recording.begins()[1:]
    apart = actions[:-1][follows] - actions[1:, :1][follows]
    if not len(apart):
        return True
    errors = (apart**2).sum(axis=2).mean(axis=0)
    return int(errors.argmin()) <= 1 or bool(errors[1] <= SAME_ACTION * errors.max())


@dataclass(frozen=True, eq=False)
class Reader:
    """Makes series of recordings of a spec.

    Args:
        motions: image -> what turns it into numbers.
        codes: input of integers -> the values that its last element has, ascending.
    """

    spec: PolicySpec
    names: Names
    motions: Mapping[str, Motion] = field(default_factory=dict)
    codes: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def variants(self, recording: Recording, changes: Changes | None = None) -> tuple[list[Series], Reader]:
        """Return the signals of a recording, with more noise, and of moved cameras; and a reader that knows images."""
        chosen, episodes, groups = rows_of(recording, self.spec)
        values = {name: _matrix(recording.inputs[name], chosen) for name in self.names.vectors}
        if self.names.commands and recording.actions is not None:
            values[self.names.commands] = self._commands(recording.actions, chosen)
        grey = {}
        for tensor in (each.observation for each in self.spec.inputs if each.name in self.names.images):
            source, change = (changes or {}).get(tensor.name, (tensor.name, None))
            means = blocks(tensor, recording.inputs[source], chosen)
            grey[tensor.name] = (change(means) if change else means).mean(axis=-1)
        reader = replace(self, motions=self.motions or {name: Motion.of(images) for name, images in grey.items()})
        last = {
            name: in_memory(recording.inputs[name])[chosen].reshape(len(chosen), -1)[:, -1] for name in self.names.codes
        }
        known = {name: np.unique(each) for name, each in last.items()}
        reader = replace(
            reader, codes=self.codes or {name: each for name, each in known.items() if len(each) <= MAX_CODES}
        )
        values |= {name: (last[name][:, None] == each).astype(np.float64) for name, each in reader.codes.items()}
        series = Series(values, episodes, groups)
        moved = {name: np.roll(images, SHIFT, axis=(1, 2)) for name, images in grey.items()}
        seen = ((series, grey), _with_noise(series, self.names, grey), (series, moved))
        return [reader._with_images(*each) for each in seen], reader

    def _with_images(self, series: Series, grey: Mapping[str, Array]) -> Series:
        values = dict(series.values)
        for name, images in grey.items():
            values[name] = self.motions[name].motion(images, series)
            values[name + PLACES] = self.motions[name].places(images)
        return replace(series, values=values)

    def _commands(self, recorded: Array | Rows, chosen: Indices) -> Array:
        actions = in_memory(recorded)[chosen][:, 0]
        if self.spec.action.kind == "discrete":
            return np.eye(len(self.spec.action.labels) or int(actions.max()) + 1)[actions]
        return actions.astype(np.float64).reshape(len(chosen), -1)


def _with_noise(series: Series, names: Names, grey: Mapping[str, Array]) -> tuple[Series, dict[str, Array]]:
    """Return vectors and images as worse sensors see them."""
    random = np.random.default_rng(0)
    values = dict(series.values)
    for name in names.vectors:
        step = np.sqrt((series.change(name) ** 2).mean(axis=0))
        values[name] = values[name] + STEP_NOISE * step * random.standard_normal(values[name].shape)
    noisy = {name: images + GREY_NOISE * images.max() * random.standard_normal(images.shape)
             for name, images in grey.items()}  # fmt: skip
    return replace(series, values=values), noisy


def _matrix(values: Any, chosen: Indices) -> Array:
    matrix: Array = in_memory(values)[chosen].astype(np.float64).reshape(len(chosen), -1)
    return matrix


def rows_of(recording: Recording, spec: PolicySpec) -> tuple[Indices, Indices, Indices]:
    """Return the rows that are read, the stretch each is of, and its group."""
    begins = recording.begins()
    if recording.times is not None and spec.control_hz:
        begins[1:] |= np.abs(np.diff(recording.times) * spec.control_hz - 1) > 0.5
    stretch = np.cumsum(begins) - 1
    if stretch[-1] == 0:
        stretch = np.minimum(np.arange(len(recording)) * WHOLE // len(recording), WHOLE - 1)
    numbers, lengths = np.unique(stretch, return_counts=True)
    share = max(1, int(np.ceil(lengths.sum() / MAX_ROWS)))
    chosen = np.flatnonzero(np.isin(stretch, numbers[::share]))
    _, episodes = np.unique(stretch[chosen], return_inverse=True)
    return chosen, episodes.astype(np.int64), _groups(recording, spec, chosen, episodes)


def _groups(recording: Recording, spec: PolicySpec, chosen: Indices, episodes: Any) -> Indices:
    """Return the task of each row, by its texts; its episode, where there are few tasks."""
    for tensor in spec.inputs:
        if tensor.kind == "text":
            tasks = np.unique(in_memory(recording.inputs[tensor.name])[chosen].astype(str), return_inverse=True)[1]
            if tasks.max() + 1 >= MIN_GROUPS:
                return np.asarray(tasks, np.int64)
    return np.asarray(episodes, np.int64)
