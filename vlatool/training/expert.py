"""Recorded actions of an expert: a second term of the loss, with its own rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.data import Recording, calibration_recording
from vlatool.episodes.frames import file_of
from vlatool.errors import DataError, require
from vlatool.files.rows import in_memory
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.runtime.converter import action_converter
from vlatool.runtime.interface import Array
from vlatool.runtime.statistics import load_normaliser
from vlatool.training.frames import BLOCK_ROWS, Frames, new_array
from vlatool.training.rounds import EXPERT, NOISE, Observations, next_round, write_observations
from vlatool.training.sequences import Sequences, episode_begins, outputs_and_labels, select_episodes

if TYPE_CHECKING:
    from torch import Tensor, nn

FOLDER = "expert"
CHOICE = 1
"""Distinguishes the random numbers that choose observations from those of noise and batches."""
RECORD = "record what was done ('action' in the file that calibration: names in policy.yaml), or use --alpha 1"


class Expert:
    """Recorded observations with the expert's actions, encoded, in a folder of their own.

    Args:
        folder: folder of the training, or of what it holds out.
        frames: folder -> the rounds in it, as the objective takes them.
    """

    def __init__(self, folder: Path, frames: Callable[[Path], Frames] = Frames) -> None:
        self.frames = frames(folder / FOLDER)
        self.counts: dict[str, int] = {}

    def prepare(
        self,
        recording: Observations | None,
        source: Bundle,
        share: float,
        seed: int,
        encode: Callable[[Any], Mapping[str, Array]],
    ) -> None:
        """Choose observations, and write them with the expert's actions unless an earlier run did.

        Args:
            share: share of them, at least one.
            seed: seed of the choice; a smaller share is a part of a larger one.
            encode: observation -> what the policy takes.

        Raises:
            DataError: when an expert's actions are missing.
        """
        if not isinstance(recording, Recording) or recording.actions is None:
            where = recording.path if isinstance(recording, Recording) else source.path
            raise DataError(f"A loss against an expert's actions needs them, and {where} has none.", RECORD)
        recording = recording.with_whole_chunks()
        order = np.random.default_rng((seed, CHOICE)).permutation
        if isinstance(self.frames, Sequences):
            used = select_episodes(episode_begins(recording), share, order)
        else:
            used = np.zeros(len(recording), np.bool_)
            used[order(len(recording))[: max(1, round(share * len(recording)))]] = True
        chosen = recording.subset(used)
        self.counts = {"used": len(chosen), "recorded": len(recording)}

        def write(target: Path) -> None:
            action = source.manifest.spec.action
            write_observations(encode, chosen, target, chosen.begins())
            states = None if (state := source.manifest.spec.reference) is None else chosen.inputs[state.name]
            np.save(file_of(target, EXPERT + action.name), encoded_actions(action, source, chosen.actions, states))
            write_noise(source, len(chosen), (seed, CHOICE), target)

        if not self.frames.count:
            next_round(self.frames, 0, write)

    def round(self) -> dict[str, Any]:
        """Return what a training says of these observations where they are all that there is to learn from."""
        return {"step": 0, "actor": "expert", "observations": len(self.frames)}

    def read(self) -> None:
        """Use what another process wrote, if it did."""
        if not self.frames.count and self.frames.has(0):
            self.frames.read(0)


def at_most(source: Bundle, most: int, *, whole: bool = False) -> Recording | None:
    """Return so many recorded observations of a bundle, spread over its recording; None when it has none.

    Args:
        whole: whether these are whole episodes.

    Raises:
        DataError: as ``episode_begins`` does, where they are.
    """
    recording = calibration_recording(source)
    if recording is None:
        return None
    if whole:
        order = np.random.default_rng(CHOICE).permutation
        return recording.subset(select_episodes(episode_begins(recording), most / len(recording), order))
    used = np.zeros(len(recording), np.bool_)
    used[recording.spread(most)] = True
    return recording.subset(used)


def encoded_actions(action: TensorSpec, source: Bundle, actions: Any, states: Any = None) -> Array:
    """Return recorded actions as a graph gives them: (N, T, A) normalised float32, or (N, T) int64 indices.

    Args:
        states: (N, S) what they are relative to in the graph, where the spec says so.

    Raises:
        SpecError: when a step of ``convert`` cannot be undone.
    """
    if action.kind == "discrete":
        return np.asarray(in_memory(actions), np.int64)
    physical = np.asarray(in_memory(actions), np.float32)
    if not action.convert:
        normaliser = load_normaliser(action, source)
        return physical if normaliser is None else normaliser.forward(physical)
    converter = action_converter(source.manifest.spec, source)
    known = repeat(None) if states is None else np.asarray(in_memory(states), np.float32)
    return np.stack([converter.to_network(chunk, state) for chunk, state in zip(physical, known, strict=False)])


def write_noise(source: Bundle, rows: int, seed: Sequence[int], target: Path) -> None:
    """Write for so many rows what the program draws, if it draws anything."""
    wanted = {name: noise for step in source.manifest.program for name, noise in step.noise.items()}
    random, kept = np.random.default_rng(seed), dict[str, Array]()
    for start in range(0, rows, BLOCK_ROWS) if wanted else ():
        for name, value in draw_noise(wanted, min(BLOCK_ROWS, rows - start), random).items():
            if name not in kept:
                kept[name] = new_array(file_of(target, NOISE + name), value.numpy().dtype, (rows, *value.shape[1:]))
            kept[name][start : start + len(value)] = value.numpy()


def expert_loss(
    modules: Mapping[str, nn.Module], source: Bundle, distance: Any
) -> Callable[[Mapping[str, Any]], Tensor]:
    """Return the loss of the student against the expert's actions: rows, as ``Expert`` wrote them -> their mean.

    Discrete actions: the cross-entropy, at temperature 1 (Hinton, Vinyals and Dean, arXiv 1503.02531, section 2).
    Continuous ones: ``distance``, over the leading steps that were recorded.

    Args:
        distance: student's and expert's actions, (B, T, A) each -> the mean over them.
    """
    action = source.manifest.spec.action
    student = BatchedProgram(source.manifest.program, modules)

    def loss(rows: Mapping[str, Any]) -> Tensor:
        given, expert = outputs_and_labels(student, rows, action.name, EXPERT)
        given = given.float()
        given = given.reshape(len(given), -1, given.shape[-1])[:, : expert.shape[1]]
        if action.kind != "discrete":
            far: Tensor = distance(given, expert)
            return far
        entropy = require("torch", "build").nn.functional.cross_entropy
        wrong: Tensor = entropy(given.flatten(0, 1), expert.flatten())
        return wrong

    return loss
