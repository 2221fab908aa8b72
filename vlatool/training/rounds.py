"""Rounds of training data: recordings or episodes, with the teacher's labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.environment import timeout_of
from vlatool.episodes.frames import file_of
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, require
from vlatool.files.printable import amount
from vlatool.module.batched_program import PATH, BatchedProgram, draw_noise
from vlatool.module.origin import origin_of
from vlatool.runtime.interface import Array
from vlatool.stage.base import Context
from vlatool.training.device import on_device
from vlatool.training.frames import Frames, begins_file, new_array
from vlatool.training.lanes import reset, side_by_side

if TYPE_CHECKING:
    from torch import Tensor

LABEL, NOISE, EXPERT = "teacher.", "noise.", "expert."
"""Prefixes of what is kept beside the inputs: the teacher's outputs, the noise that they were made from, and what an
expert did."""
NUMBER, BEFORE, AFTER = "turn", "before.", "after."
"""Further labels where turns of a loop are learnt: the number of a turn, what was carried before it and after."""
ROWS = 32
"""Rows that the teacher labels at a time."""


def scene_of(source: Bundle) -> tuple[EpisodesJob, tuple[str, ...]] | None:
    """Return the environment and the tasks of a policy's description; None without an environment."""
    origin = origin_of(source)
    make, tasks = origin.environment.get("make"), origin.environment.get("tasks")
    if not make or not tasks:
        return None
    timeout = timeout_of(origin.environment)
    return EpisodesJob(str(make), str(origin.folder), "", (), timeout_s=timeout), tuple(tasks)


class Observations(Protocol):
    """A sized iterable of observations that are read one by one."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Any]: ...


def write_observations(
    encode: Callable[[Any], Mapping[str, Array]], observations: Observations, target: Path, begins: Array | None = None
) -> None:
    """Write encoded observations as a part of a round, one after the other: they need not fit into the memory.

    Args:
        encode: observation -> what the policy takes.
        observations: observations in the order of their episodes, where these matter.
        target: folder of the part.
        begins: (N,) whether an episode begins with an observation; None where that does not matter.
    """
    if begins is not None and len(begins):
        target.mkdir(parents=True, exist_ok=True)
        np.save(begins_file(target), begins)
    target.mkdir(parents=True, exist_ok=True)
    kept: dict[str, Array] = {}
    for row, observation in enumerate(observations):
        for name, value in encode(observation).items():
            if name not in kept:
                kept[name] = new_array(file_of(target, name), value.dtype, (len(observations), *value.shape[1:]))
            kept[name][row] = value[0]


def write_labels(frames: Path, names: Sequence[str], outputs: Sequence[str], teacher: BatchedProgram,
                 seed: Sequence[int], context: Context, *, turns: bool = False) -> list[str]:  # fmt: skip
    """Write the teacher's outputs for every row of a round, and the noise that it drew, beside the inputs.

    A teacher that keeps values is run along the episodes.

    Args:
        teacher: its program.
        turns: whether to write also one random turn of the teacher's loop for each row.

    Returns:
        Names of the labels.

    Raises:
        DataError: when the teacher gives something that is not finite.
        SourceError: when it fails.
    """
    torch = require("torch", "build")
    inputs = {name: np.load(file_of(frames, name), mmap_mode="r") for name in names}
    count = len(next(iter(inputs.values())))
    kept: dict[str, Any] = {}
    begins = np.load(begins_file(frames)) if teacher.kept else None
    with torch.no_grad():
        for key, rows, own, values, noise in _teacher_batches(teacher, inputs, begins, seed, turns=turns):
            labels = {name: values[name] for name in outputs}
            labels |= _turns(teacher, values, np.random.default_rng((*key, 1))) if turns else {}
            given = {LABEL + name: value for name, value in labels.items()}
            given |= {NOISE + name: noise[name] for name in noise}
            for name, value in given.items():
                if name not in kept:
                    kept[name] = new_array(file_of(frames, name), value.cpu().numpy().dtype, (count, *value.shape[1:]))
                if value.is_floating_point() and not bool(torch.isfinite(value).all()):
                    raise DataError("The teacher gives an action that is not finite.", "look at the recordings")
                kept[name][rows[own]] = value.cpu().numpy()[own]
            context.progress(f"the teacher labels {amount(count, 'observation')}", (int(rows[0]) + 1) / count)
    return [name.removeprefix(LABEL) for name in kept if name.startswith(LABEL)]


def _teacher_batches(
    teacher: BatchedProgram, inputs: Mapping[str, Array], begins: Array | None, seed: Sequence[int], *, turns: bool
) -> Iterator[tuple[Sequence[int], Array, Array, dict[str, Tensor], dict[str, Tensor]]]:
    """Yield batches of the teacher: seed, rows (B,), mask of the rows to write, its values, and the noise.

    Args:
        inputs: name -> (N, ...).
        begins: (N,) whether an episode begins with a row; None for a teacher that keeps nothing.
    """
    run = teacher.path if turns else teacher.run
    if begins is None:
        count = len(next(iter(inputs.values())))
        for start in range(0, count, ROWS):
            rows, key = np.arange(start, min(count, start + ROWS)), (*seed, start)
            noise = draw_noise(teacher.noise, len(rows), np.random.default_rng(key))
            yield key, rows, np.ones(len(rows), np.bool_), run(_rows_at(inputs, rows), noise), noise
        return
    for lanes in side_by_side(begins, ROWS):
        held: dict[str, Tensor] = {}
        for time, (rows, new, counts) in enumerate(lanes.steps()):
            key = (*seed, int(lanes.firsts[0]), time)
            noise = draw_noise(teacher.noise, len(rows), np.random.default_rng(key))
            values = run(_rows_at(inputs, rows), {**noise, **reset(held, new)})
            held = teacher.kept_of(values)
            yield key, rows, counts, values, noise


def _rows_at(inputs: Mapping[str, Array], rows: Array) -> dict[str, Tensor]:
    return {name: on_device(np.array(values[rows])) for name, values in inputs.items()}


def _turns(teacher: BatchedProgram, values: Mapping[str, Tensor], random: np.random.Generator) -> dict[str, Tensor]:
    """Return for each row the number of a turn, and the values that the teacher carried into and out of it."""
    if teacher.loop is None:
        raise ValueError("a program with a loop has turns")
    paths = {name: values[PATH + name] for name in teacher.loop.carry.values()}
    size = len(next(iter(paths.values())))
    number = on_device(random.integers(teacher.loop.repeat, size=size))
    rows = on_device(np.arange(size))
    before = {BEFORE + name: path[rows, number] for name, path in paths.items()}
    return {NUMBER: number, **before, **{AFTER + name: path[rows, number + 1] for name, path in paths.items()}}


def tensors(rows: Mapping[str, Any], prefix: str = "") -> dict[str, Tensor]:
    """Return the arrays of a batch with a prefix, without the prefix, as tensors."""
    others = (LABEL, NOISE, EXPERT)
    return {
        name[len(prefix) :]: on_device(value)
        for name, value in rows.items()
        if (name.startswith(prefix) if prefix else not name.startswith(others))
    }


def next_round(frames: Frames, number: int, fill: Any) -> None:
    """Use a round; ``fill`` writes it into a folder first, unless an earlier run did."""
    if not frames.has(number):
        draft = frames.draft(number)
        fill(draft)
        frames.keep(number)
    frames.read(number)
