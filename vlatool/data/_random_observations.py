"""Observations that cannot be known beforehand: recorded ones under other instructions, and drawn ones.

What is judged on observations that its maker knows can be made to be good on those alone. These are drawn anew for each
process: from recordings where there are any, from the words of the vocabulary, and over what each input can hold.
"""

from __future__ import annotations

import json
import string
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.data._not_finite import KINDS, takes_not_finite, with_not_finite
from vlatool.data._recording import Recording
from vlatool.errors import DataError
from vlatool.runtime.statistics import Normaliser, load_normaliser

Array = NDArray[Any]
RECORDED_KIND, REWORDED_KIND, RANDOM_KIND = "recorded", "other", "drawn"
PATTERN = (RECORDED_KIND, REWORDED_KIND, RECORDED_KIND, RANDOM_KIND)
EXTREME = 4.0
"""Standard deviations (or halves of the range) up to which a state is drawn."""
LENGTHS = (0, 1, 2, 3, 5, 8, 13)
"""Words of an instruction."""


@dataclass(frozen=True)
class Drawn:
    """One observation and where it comes from.

    Args:
        kind: ``recorded`` (a sample of a recording), ``other`` (a recorded sample with another instruction, or whose
            inputs are of different samples) or ``drawn`` (nothing of it was recorded).
        observation: Input name -> value without the batch axis, in physical units; text as ``str``.
    """

    kind: str
    observation: dict[str, Any]


class Drawer:
    """Draws observations that fit a bundle's spec.

    Args:
        bundle: Whose spec, vocabulary and statistics say what an observation may hold.

    Raises:
        SpecError: when statistics are missing or do not fit.
    """

    def __init__(self, bundle: Bundle, recordings: Sequence[Recording] = ()) -> None:
        self._spec = bundle.manifest.spec
        self._inputs = self._spec.inputs
        self._recordings = [recording for recording in recordings if len(recording)]
        assets = bundle.path / "assets"
        texts = [tensor for tensor in self._inputs if tensor.kind == "text"]
        self._words = {text.name: words_of(assets / text.tokenizer) for text in texts}
        self._normalisers = {tensor.name: load_normaliser(tensor.observation, assets) for tensor in self._inputs}

    def draw(self, count: int, random: np.random.Generator) -> list[Drawn]:
        """Return ``count`` observations of all kinds that can be drawn, in random order."""
        kinds = [PATTERN[number % len(PATTERN)] if self._recordings else RANDOM_KIND for number in range(count)]
        drawn = partial(self._drawn, structured=Structures(random))
        makers: dict[str, Callable[[np.random.Generator], dict[str, Any]]]
        makers = {RECORDED_KIND: self._recorded, REWORDED_KIND: self._other, RANDOM_KIND: drawn}
        return [Drawn(kinds[index], makers[kinds[index]](random)) for index in random.permutation(count)]

    def _recorded(self, random: np.random.Generator) -> dict[str, Any]:
        recording = self._recordings[int(random.integers(len(self._recordings)))]
        return recording.observation(int(random.integers(len(recording))))

    def _other(self, random: np.random.Generator) -> dict[str, Any]:
        """A recorded sample under another instruction; without text, inputs of samples that differ."""
        if not self._words:
            return {tensor.name: self._recorded(random)[tensor.name] for tensor in self._inputs}
        return self._recorded(random) | {
            tensor.name: self._sentence(tensor, random) for tensor in self._inputs if tensor.kind == "text"
        }

    def _drawn(self, random: np.random.Generator, structured: Structures) -> dict[str, Any]:
        like = self._recorded(random) if self._recordings else {}
        values = {
            tensor.name: self._value(tensor.observation, like.get(tensor.name), random, structured)
            for tensor in self._inputs
        }
        if not takes_not_finite(self._spec):
            return values
        return with_not_finite(self._spec, [values], int(random.integers(len(KINDS))))[0]

    def _value(self, tensor: TensorSpec, like: Any, random: np.random.Generator, structured: Structures) -> Any:
        if tensor.kind == "text":
            return self._sentence(tensor, random)
        shape = _shape(tensor, like)
        dtype = np.dtype(tensor.dtype)
        if dtype.kind == "b":
            return random.integers(0, 2, shape).astype(np.bool_)
        if dtype.kind in "iu":
            return _whole_numbers(tensor, like, shape, random, structured)
        values = structured(tensor.name, shape)
        return _physical(values, self._normalisers[tensor.name], like).astype(dtype)

    def _sentence(self, tensor: TensorSpec, random: np.random.Generator) -> str:
        lengths = [length for length in LENGTHS if length <= tensor.max_tokens] or [0]
        return sentence(self._words[tensor.name], random, lengths)


def sentence(words: Sequence[str], random: np.random.Generator, lengths: Sequence[int]) -> str:
    """Return words of a vocabulary, as many as one of the lengths says; nothing of an empty vocabulary."""
    if not words:
        return ""
    return " ".join(words[index] for index in random.integers(len(words), size=int(random.choice(lengths))))


def words_of(path: Path) -> list[str]:
    """Return the words of a vocabulary, or those tokens of a ``tokenizers`` file that are words.

    Raises:
        DataError: when the file cannot be read.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(
            f"The vocabulary {path} cannot be read: {error}.",
            "copy the bundle again from where it was made, or make it again",
        ) from error
    if not isinstance(data, dict) or not isinstance(data.get("model", {}), dict):
        raise DataError(
            f"The vocabulary {path} is not a mapping of words or tokens.",
            "export the policy again: the vocabulary in the bundle is not what a policy can be asked with",
        )
    listed = data.get("words") if data.get("kind") == "words" else data.get("model", {}).get("vocab", ())
    tokens = [item[0] if isinstance(item, list) else item for item in listed or ()]
    if data.get("kind") == "words":
        return [token for token in tokens if token] or list(string.ascii_lowercase)
    bare = {token.lstrip("\u0120\u2581") for token in tokens if token[:1] in "\u0120\u2581" or token.isalpha()}
    return sorted(word for word in bare if word.isalpha()) or list(string.ascii_lowercase)


def _shape(tensor: TensorSpec, like: Any) -> tuple[int, ...]:
    if like is not None:
        return tuple(np.shape(like))
    return tuple(axis if isinstance(axis, int) else 1 for axis in tensor.shape[1:])


def _whole_numbers(
    tensor: TensorSpec, like: Any, shape: tuple[int, ...], random: np.random.Generator, structured: Structures
) -> Array:
    """Pixels over their range; other whole numbers over that of a recorded sample."""
    if tensor.dtype == "uint8":
        values = structured(tensor.name, shape)
        return np.clip(np.rint(127.5 + 127.5 / EXTREME * 2 * values), 0, 255).astype(np.uint8)
    least = 0 if tensor.shape else 1  # 0 is an id of any vocabulary; a number without axes may be divided by
    low, high = (least, least) if like is None or not np.size(like) else (int(np.min(like)), int(np.max(like)))
    return random.integers(low, high + 1, shape).astype(tensor.dtype)


def _noise(shape: tuple[int, ...], random: np.random.Generator) -> Array:
    return random.standard_normal(shape)


def _constant(shape: tuple[int, ...], random: np.random.Generator) -> Array:
    return np.full(shape, random.uniform(-2, 2))


def _gradient(shape: tuple[int, ...], random: np.random.Generator) -> Array:
    """A ramp along each axis, of its own slope."""
    values = np.zeros(shape)
    for axis, length in enumerate(shape):
        ramp = np.linspace(-1, 1, length) if length > 1 else np.zeros(1)
        values = values + random.normal() * ramp.reshape([-1 if index == axis else 1 for index in range(len(shape))])
    return values


def _extreme(shape: tuple[int, ...], random: np.random.Generator) -> Array:
    return random.choice([-EXTREME, EXTREME], size=shape)


STRUCTURES = (_noise, _constant, _gradient, _extreme)


class Structures:
    """Values about N(0, 1), never beyond ``EXTREME``: noise, one value, ramps and extremes, each input's in turn.

    Which one an input begins with is drawn. Extremes come in pairs of opposite signs, so that of eight observations one
    has each element at its highest, and one at its lowest: left to chance, some gates would see neither.
    """

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._turns: dict[str, int] = {}
        self._opposite: dict[str, Array] = {}

    def __call__(self, name: str, shape: tuple[int, ...]) -> Array:
        """Return the next values of an input."""
        turn = self._turns.get(name, int(self._random.integers(len(STRUCTURES))))
        self._turns[name] = turn + 1
        structure = STRUCTURES[turn % len(STRUCTURES)]
        opposite = self._opposite.pop(name, None) if structure is _extreme else None
        if opposite is not None and opposite.shape == shape:
            return opposite
        values = np.asarray(np.clip(structure(shape, self._random), -EXTREME, EXTREME))
        if structure is _extreme:
            self._opposite[name] = -values
        return values


def _physical(values: Array, normaliser: Normaliser | None, like: Any) -> Array:
    """Return values about N(0, 1) in the units of an input: by its statistics, else by what was recorded."""
    if normaliser is not None:
        return np.asarray(normaliser.inverse(values.astype(np.float32)))
    if like is None:
        return values
    recorded = np.asarray(like, np.float64)
    recorded = recorded[np.isfinite(recorded)] if recorded.size else recorded
    if not recorded.size:
        return values
    return np.asarray(values * (recorded.std() or 1.0) + recorded.mean())


def save_drawn(path: Path, drawn: Sequence[Drawn]) -> None:
    """Write observations to an ``.npz`` file."""
    arrays: dict[str, Any] = {
        f"{index}.{name}": np.asarray(value)
        for index, item in enumerate(drawn)
        for name, value in item.observation.items()
    }
    np.savez(path, kind=np.array([item.kind for item in drawn]), **arrays)


def read_drawn(path: Path) -> list[Drawn]:
    """Read what ``save_drawn`` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        observations = [Drawn(str(kind), {}) for kind in stored["kind"]]
        for key in stored.files:
            index, _, name = key.partition(".")
            if name:
                value = stored[key]
                observations[int(index)].observation[name] = str(value) if value.dtype.kind == "U" else value
    return observations
