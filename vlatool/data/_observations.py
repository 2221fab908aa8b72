"""Observations to export, check and calibrate with: recorded ones, or synthetic ones when there are none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data._not_finite import with_not_finite
from vlatool.data._random_observations import sentence, words_of
from vlatool.data._recording import Moment, Recording
from vlatool.data._selections import calibration_recording
from vlatool.errors import DataError

MAX_WORDS = 8
"""Words of a synthetic instruction at most."""


class Observations(Sequence[dict[str, Any]]):
    """Samples of a recording, each read when it is asked for."""

    def __init__(self, recording: Recording, numbers: Sequence[int]) -> None:
        self._recording = recording
        self._numbers = numbers

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, at: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, at: slice) -> Observations: ...

    def __getitem__(self, at: int | slice) -> dict[str, Any] | Observations:
        """Return one observation, or those of a slice, which are read later."""
        if isinstance(at, slice):
            return Observations(self._recording, self._numbers[at])
        return self._recording.observation(self._numbers[at])

    def with_history(self) -> Iterator[Moment]:
        """Yield them, each after those before it in its episode."""
        return self._recording.with_history(self._numbers)


def recorded_observations(source: Bundle, count: int, path: Path | None = None) -> Sequence[dict[str, Any]]:
    """Return up to ``count`` recorded observations, spread over the recording; none when the bundle carries none.

    They stay on the disk until they are asked for.

    Args:
        path: A recording to read in the place of the bundle's own.
    """
    recording = calibration_recording(source, path)
    return [] if recording is None else Observations(recording, recording.spread(count))


def observations_for(source: Bundle, count: int, path: Path | None = None) -> list[dict[str, Any]]:
    """Return recorded observations, in memory, or synthetic ones when the bundle carries none.

    Three in four hold NaN and infinity in inputs that take them, whatever was recorded.
    """
    observations = list(recorded_observations(source, count, path))
    return with_not_finite(source.manifest.spec, observations) or synthetic_observations(source, count)


def synthetic_observations(source: Bundle, count: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return seeded random observations that fit a bundle's spec: good for shapes and timing, not for accuracy.

    Instructions are words of the vocabulary: an empty one is padding alone, which many policies mask away as a whole.
    """
    spec = source.manifest.spec
    words = {tensor.name: _words(source, tensor) for tensor in spec.inputs if tensor.kind == "text"}
    return random_observations(spec, count, seed, words)


def random_observations(
    spec: PolicySpec, count: int, seed: int = 0, words: Mapping[str, Sequence[str]] | None = None
) -> list[dict[str, Any]]:
    """Return seeded random observations that fit a spec; its instructions are of ``words``: input -> vocabulary."""
    random = np.random.default_rng(seed)
    drawn = [
        {each.name: _synthetic(each.observation, random, words or {}) for each in spec.inputs} for _ in range(count)
    ]
    return with_not_finite(spec, drawn)


def _words(source: Bundle, tensor: TensorSpec) -> list[str]:
    """Return the words of an input's vocabulary; none where it cannot be read, which the encoder refuses."""
    try:
        return words_of(source.path / "assets" / tensor.tokenizer)
    except DataError:
        return []


def _synthetic(tensor: TensorSpec, random: np.random.Generator, words: Mapping[str, Sequence[str]]) -> Any:
    if tensor.kind == "text":
        return sentence(words.get(tensor.name, ()), random, range(1, min(MAX_WORDS, tensor.max_tokens) + 1))
    shape = tuple(axis if isinstance(axis, int) else 1 for axis in tensor.shape[1:])
    if tensor.dtype == "uint8":
        return random.integers(0, 256, shape, np.uint8)
    if tensor.dtype == "bool":
        return np.ones(shape, np.bool_)
    if np.dtype(tensor.dtype).kind in "iu":  # 0 is an id of any vocabulary; a number without axes may be divided by
        return np.full(shape, 0 if tensor.shape else 1, tensor.dtype)
    return np.asarray(random.standard_normal(shape), tensor.dtype)
