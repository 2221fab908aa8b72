"""How the images of a camera look, whatever they show: red for blue, flipped, of another camera.

The images of the reference are changed as wrong wiring would change them, and a linear classifier (ridge regression on
one indicator a change) tells the versions apart by mean colours of blocks and by a histogram of colours, both relative
to the brightness. How well, on episodes it was not fitted on, says what a log must show to be called wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import TensorSpec
from vlatool.stats.intervals import student
from vlatool.verify._images import channel_axis
from vlatool.verify._series import blocks
from vlatool.verify._views import folds, ridge

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
MAX_FRAMES = 240
BINS, PIXELS_PER_SIDE = 4, 24
LIGHT, TINT = 0.15, 0.05
"""Deviation of the logarithm of the brightness, and of each colour, that another light may have."""
ALARM = 1e-3
RIGHT = ("", "")
Kind = tuple[str, str]
"""Kind of change, and words."""


@dataclass(frozen=True, eq=False)
class Looks:
    """Images as the classifier sees them.

    Args:
        blocks: (N, G, G, C) mean colours.
        colours: (N, BINS, BINS, BINS) shares of the pixels.
    """

    blocks: Array
    colours: Array

    @classmethod
    def of(cls, tensor: TensorSpec, frames: Any, rows: Indices) -> Looks:
        """Look at some images."""
        return cls(blocks(tensor, frames, rows), np.stack([_pixels(tensor, frames[int(row)]) for row in rows]))

    def relit(self, seed: int) -> Looks:
        """Return the images in another light each."""
        random = np.random.default_rng(seed)
        count, channels = len(self.blocks), self.blocks.shape[-1]
        gain = np.exp(LIGHT * random.standard_normal((count, 1)) + TINT * random.standard_normal((count, channels)))
        return Looks(self.blocks * gain[:, None, None], self.colours * gain[:, None])

    def with_change(self, change: Callable[[Array], Array], channels: Callable[[Array], Array]) -> Looks:
        """Return the images after a change of places and of channels."""
        return Looks(channels(change(self.blocks)), channels(self.colours))

    def features(self) -> Array:
        """Return what is compared, relative to the brightness, (N, F)."""
        bright = self.blocks.mean(axis=(1, 2, 3), keepdims=True) + 1e-9
        levels = np.clip(self.colours / bright[:, 0] * BINS / 3, 0, BINS - 1e-3).astype(int)
        codes = (levels[..., :3] * BINS ** np.arange(3)).sum(axis=-1)
        shares = np.stack([np.bincount(row, minlength=BINS**3) for row in codes]) / codes.shape[1]
        flat = (self.blocks / bright).reshape(len(self.blocks), -1)
        return np.concatenate([flat, np.sqrt(shares)], axis=1)

    @property
    def top(self) -> float:
        """The brightest colour."""
        return float(max(self.blocks.max(), self.colours.max()))


def _pixels(tensor: TensorSpec, frame: Any) -> Array:
    """Return some pixels of the last moment, (P, C)."""
    image = np.moveaxis(np.asarray(frame, np.float64), channel_axis(tensor), -1)
    image = image.reshape(-1, *image.shape[-3:])[-1]
    rows, columns = (np.unique(np.linspace(0, size - 1, PIXELS_PER_SIDE).astype(int)) for size in image.shape[:2])
    pixels: Array = image[np.ix_(rows, columns)].reshape(-1, image.shape[-1])
    return pixels


def _same(images: Array) -> Array:
    return images


def _reversed(images: Array) -> Array:
    return images[..., ::-1]


CHANGES: dict[Kind, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    RIGHT: (_same, _same),
    ("bgr", "red and blue are exchanged"): (_same, _reversed),
    ("flipped", "left and right"): (lambda images: images[:, :, ::-1], _same),
    ("flipped", "upside down"): (lambda images: images[:, ::-1], _same),
    ("flipped", "turned by 180 degrees"): (lambda images: images[:, ::-1, ::-1], _same),
}


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the images of a log look like.

    Args:
        kind: the change, ``RIGHT`` for none that is proven.
        margin: by how much the classifier prefers it.
        needed: what it never prefers a change by in a right log.
        fits: whether images with that change are preferred by as much.
        unseen: changes that could not be told.
    """

    kind: Kind
    margin: float
    needed: float
    fits: bool
    unseen: tuple[Kind, ...]


@dataclass(frozen=True, eq=False)
class Appearance:
    """A classifier of the images of one camera.

    Args:
        needed: change -> margin over right images that right ones do not reach.
        expected: change -> margin that images with it do not stay below.
        top: brightest colour of the reference.
    """

    kinds: Sequence[Kind]
    weights: Array
    needed: Mapping[Kind, float]
    expected: Mapping[Kind, float]
    top: float

    @classmethod
    def of(cls, looks: Mapping[str, Looks], name: str, groups: Indices, episodes: Indices) -> Appearance:
        """Fit a classifier for an input, of the images of it and of those of its shape."""
        versions = {kind: looks[name].with_change(*changes) for kind, changes in CHANGES.items()}
        versions |= {("swapped", f"it shows '{other}'"): each for other, each in looks.items() if other != name}
        kinds = list(versions)
        features = {kind: np.stack([each.features(), each.relit(1).features()]) for kind, each in versions.items()}
        margins: dict[Kind, dict[Kind, list[float]]] = {kind: {other: [] for other in kinds} for kind in kinds}
        for out in folds(groups):
            if out.all():
                continue
            weights = _fit(kinds, features, ~out)
            for kind in kinds:
                for lit in features[kind]:
                    scores = lit @ weights[:-1] + weights[-1]
                    for number in np.unique(episodes[out]):
                        mean = scores[out & (episodes == number)].mean(axis=0)
                        for at, other in enumerate(kinds):
                            margins[kind][other].append(float(mean[at] - mean[0]))
        needed = {kind: _limit(margins[RIGHT][kind], 1) for kind in kinds[1:]}
        expected = {kind: _limit(margins[kind][kind], -1) for kind in kinds[1:]}
        whole = _fit(kinds, features, np.ones(len(groups), bool))
        return cls(kinds, whole, needed, expected, looks[name].top)

    def judge(self, looks: Looks) -> Verdict:
        """Say what the images of a log look like."""
        unseen = tuple(kind for kind in self.kinds[1:] if self.expected[kind] <= max(self.needed[kind], 0.0))
        if (found := self._range(looks.top)) is not None:
            return Verdict(found, 1.0, 0.0, found[0] == "scaled", unseen)
        scores = (looks.features() @ self.weights[:-1] + self.weights[-1]).mean(axis=0)
        at = int(scores.argmax())
        kind, margin = self.kinds[at], float(scores[at] - scores[0])
        if at == 0 or kind in unseen or margin <= max(self.needed[kind], 0.0):
            return Verdict(RIGHT, margin, 0.0, True, unseen)
        return Verdict(kind, margin, self.needed[kind], bool(margin >= self.expected[kind]), unseen)

    def _range(self, top: float) -> Kind | None:
        """Return what is wrong with the range of values, by the brightest colour."""
        if not top < self.top:
            return ("scaled", "0-255 instead of 0-1") if self.top <= 1 < top / 2 else None
        if not top:
            return "black", "every pixel is 0"
        return ("scaled", "0-1 instead of 0-255") if top <= 1 < self.top / 2 else None


def _fit(kinds: Sequence[Kind], features: Mapping[Kind, Array], chosen: NDArray[np.bool_]) -> Array:
    rows = np.concatenate([features[kind][:, chosen].reshape(-1, features[kind].shape[-1]) for kind in kinds])
    indicators = np.repeat(np.eye(len(kinds)), len(rows) // len(kinds), axis=0)
    return ridge(rows, indicators)


def _limit(values: Sequence[float], sign: int) -> float:
    """Return what one more value passes, up or down, with the chance ``ALARM``; infinite without values."""
    if len(values) < 3:
        return sign * math.inf
    spread = float(np.std(values, ddof=1)) * math.sqrt(1 + 1 / len(values))
    return float(np.mean(values)) + sign * student(1 - ALARM, len(values) - 1) * spread
