"""Rows as episodes, for policies that keep values: windows of them, and what leads to each."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.data import BEGINS, Recording
from vlatool.errors import DataError, require
from vlatool.module.batched_program import BatchedProgram
from vlatool.runtime.interface import Array
from vlatool.training.device import on_device
from vlatool.training.frames import Frames
from vlatool.training.lanes import Lanes, reset
from vlatool.training.rounds import NOISE, tensors

if TYPE_CHECKING:
    from torch import Tensor

RECORD_EPISODES = "record 'episode': a whole number for each observation, another one where the policy is reset"


@dataclass(frozen=True)
class Unroll:
    """How far a training goes back in time.

    Args:
        window: consecutive observations that gradients pass through (truncated back-propagation through time: Williams
            and Peng, 1990).
        burn_in: observations before a window that only bring what is kept up to date (Kapturowski et al., R2D2, ICLR
            2019); all since the beginning of the episode when None.
    """

    window: int
    burn_in: int | None = None


@dataclass(frozen=True)
class EpisodeWindows:
    """What a loss takes instead of rows: the rows, and the windows in them."""

    frames: Frames
    lanes: Lanes


class Sequences(Frames):
    """Rounds of rows that say where episodes begin; drawn, counted and judged as stretches of them.

    Places are (N, 3): first row, first one that counts, and the one after the last.
    """

    def __init__(self, folder: Path, unroll: Unroll) -> None:
        super().__init__(folder)
        self._unroll = unroll

    def draw(self, random: np.random.Generator, size: int) -> Array:
        """Draw windows of so many rows together, fewer where episodes begin and end; each row is as likely."""
        window, burn_in = self._unroll.window, self._unroll.burn_in
        episodes = self._episodes(range(self.count))
        ends = np.cumsum(episodes[:, 1] - episodes[:, 0] + window - 1)
        drawn = random.integers(ends[-1], size=max(1, size // window))
        begin, end = episodes[np.searchsorted(ends, drawn, side="right")].T
        start = end - (ends[np.searchsorted(ends, drawn, side="right")] - drawn)  # from begin - window + 1 to end - 1
        starts, stops = np.maximum(start, begin), np.minimum(start + window, end)
        firsts = begin if burn_in is None else np.maximum(begin, starts - burn_in)
        return np.stack([firsts, starts, stops], 1)

    def row_count(self, windows: Array) -> int:
        """Return how many rows count."""
        return int((windows[:, 2] - windows[:, 1]).sum())

    def sample(self, numbers: Sequence[int], most: int) -> Array:
        """Return whole episodes, spread over those of some rounds, until there are so many rows."""
        episodes = self._episodes(numbers)
        lengths = episodes[:, 1] - episodes[:, 0]
        count = max(1, round(len(episodes) * min(1.0, most / max(1, int(lengths.sum())))))
        chosen = episodes[np.unique(np.linspace(0, len(episodes) - 1, count).astype(int))]
        return np.stack([chosen[:, 0], chosen[:, 0], chosen[:, 1]], 1)

    def batch(self, windows: Array) -> EpisodeWindows:
        """Return what a loss takes of drawn places."""
        return EpisodeWindows(self, Lanes(*windows.T))

    def sample_rows(self, most: int) -> dict[str, Array]:
        """Return rows of whole episodes, the last one cut short, and which of them begin one."""
        episodes = self.sample(range(self.count), most)
        rows = np.concatenate([np.arange(first, end) for first, _, end in episodes])[:most]
        return {**self.rows(rows), BEGINS: np.isin(rows, episodes[:, 0])}

    def _episodes(self, numbers: Sequence[int]) -> Array:
        """Return the first row of each episode of some rounds, and the one after its last: (E, 2)."""
        found = []
        for number in numbers:
            firsts = self.begins(number)
            found.append(np.stack([firsts, [*firsts[1:], self.row_indices(number)[-1] + 1]], 1))
        return np.concatenate(found)


def outputs_and_labels(
    program: BatchedProgram,
    rows: Mapping[str, Any] | EpisodeWindows,
    name: str,
    label: str,
    computed: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext,
) -> tuple[Tensor, Tensor]:
    """Run a student; return an output for each row that counts, and what was said of it.

    Args:
        rows: rows of a batch, name -> (B, ...); or stretches of episodes, along which it keeps its values.
        label: prefix of who said so.
        computed: function that returns the context in which the student computes.
    """
    if isinstance(rows, EpisodeWindows):
        return _outputs_along_episodes(program, rows, name, label, computed)
    inputs, noise = tensors(rows), tensors(rows, NOISE)
    program.look(inputs, noise)
    with computed():
        values = program.run(inputs, noise)
    return values[name], tensors(rows, label)[name]


def _outputs_along_episodes(
    program: BatchedProgram,
    stretches: EpisodeWindows,
    name: str,
    label: str,
    computed: Callable[[], contextlib.AbstractContextManager[Any]],
) -> tuple[Tensor, Tensor]:
    torch = require("torch", "build")
    given, said, gradients = list[Any](), list[Any](), torch.is_grad_enabled()
    kept: dict[str, Tensor] = {}
    for rows, begins, counts in stretches.lanes.steps():
        batch = stretches.frames.rows(rows)
        inputs, noise = tensors(batch), tensors(batch, NOISE)
        program.look(inputs, noise)
        with torch.set_grad_enabled(gradients and bool(counts.any())), computed():
            values = program.run(inputs, {**noise, **reset(kept, begins)})
        kept = program.kept_of(values)
        if counts.any():
            own = on_device(np.flatnonzero(counts))
            given.append(values[name][own])
            said.append(tensors(batch, label)[name][own])
    return torch.cat(given), torch.cat(said)


def episode_begins(recording: Recording) -> Array:
    """Say of each observation whether an episode begins with it: (N,).

    Raises:
        DataError: when that is not recorded, or the observations are not complete episodes.
    """
    whole = recording.whole or recording
    if recording.episodes is None:
        raise DataError(
            f"{recording.path} does not say where episodes begin, which the training of a policy that keeps values "
            "from step to step must know.",
            RECORD_EPISODES,
        )
    begins = recording.begins()
    torn = np.flatnonzero(begins & ~whole.begins()[_places(recording)])
    if len(torn):
        raise DataError(
            f"{recording.path} has too few episodes to hold whole ones out ({int(whole.begins().sum())}), and a policy "
            "that keeps values learns from whole ones.",
            "record more of them; or others to evaluate on (evaluation: FILE.npz in policy.yaml), and leave --patience "
            "out",
        )
    return begins


def _places(recording: Recording) -> Array:
    return np.arange(len(recording)) if recording.indices is None else recording.indices


def select_episodes(begins: Array, share: float, order: Callable[[int], Array]) -> Array:
    """Say of each row whether it is used: whole episodes, at least one, of about a share of all rows; (N,).

    Args:
        begins: (N,) whether an episode begins with a row.
        share: share of the rows.
        order: number of episodes -> in which order they are taken.
    """
    episodes = np.cumsum(begins) - 1
    sizes = np.bincount(episodes)
    taken = order(len(sizes))
    before = np.concatenate([[0], np.cumsum(sizes[taken])[:-1]])
    return np.isin(episodes, taken[(before < share * len(begins)) | (before == 0)])
