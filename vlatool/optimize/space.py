"""What may be pruned of a policy and how it may be quantized: what the trials of ``optimize`` choose from."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import NOT_POSSIBLE, RecipeError
from vlatool.module.edits import BLOCKS, read_edits
from vlatool.optimize.plan import transforms
from vlatool.optimize.recipe import Pruning, StageList
from vlatool.stage.base import Context
from vlatool.stage.controls import PRUNED_KEY
from vlatool.stage.run import cached_transform

WIDTHS = 6
"""Widths that are told apart, from all of the work to the least share that stays."""
HALF_WIDTH = 0.5
FLOAT32 = "float32"
"""The name of what is not quantized."""


@dataclass(frozen=True)
class Shape:
    """One pruned and quantized policy.

    Args:
        width: Share of the multiply-accumulates that stays when units go.
        blocks: Blocks that stay of the longest stack; the others lose the same share.
        steps: Denoising steps that stay.
    """

    width: float
    blocks: int
    steps: int
    quantized: str


@dataclass(frozen=True)
class Space:
    """What may be chosen.

    Args:
        widths: Shares of the work, the whole first.
        blocks: Of the longest stack that may lose some; 1 where there is none.
        steps: That the policy's program takes; 1 where it does not repeat, or cannot with fewer.
        quantized: Name -> stages; the first is what the first trials take.
        recover: What trains a pruned policy.
    """

    widths: tuple[float, ...]
    blocks: int
    steps: int
    quantized: Mapping[str, StageList]
    recover: StageList

    @property
    def is_empty(self) -> bool:
        """Whether nothing can be pruned."""
        return len(self.widths) == 1 and self.blocks == 1 and self.steps == 1

    def holds(self, shape: Shape) -> bool:
        """Return whether a shape is of this space."""
        counts = 1 <= shape.blocks <= self.blocks and 1 <= shape.steps <= self.steps
        return counts and shape.width in self.widths and shape.quantized in self.quantized

    def is_whole(self, shape: Shape) -> bool:
        """Return whether nothing is pruned."""
        return shape.width == 1 and shape.blocks == self.blocks and shape.steps == self.steps

    def name(self, shape: Shape) -> str:
        """Return what a candidate of that shape is called."""
        parts = [
            *([f"steps{shape.steps}"] if shape.steps < self.steps else []),
            *([f"blocks{shape.blocks}"] if shape.blocks < self.blocks else []),
            *([f"width{100 * shape.width:.0f}"] if shape.width < 1 else []),
        ]
        return "_".join([*(parts or ["whole"]), shape.quantized])

    def stages(self, shape: Shape) -> StageList:
        """Return what makes a candidate of that shape; the export is the recipe's."""
        pruned: list[dict[str, dict[str, Any]]] = []
        if shape.steps < self.steps:
            pruned.append({"prune.steps": {"to": shape.steps}})
        if shape.blocks < self.blocks:
            pruned.append({"prune.depth": {"ratio": _upwards(1 - shape.blocks / self.blocks)}})
        if shape.width < 1:
            pruned.append({"prune.structured": {"ratio": round(1 - shape.width, 4)}})
        return (*pruned, *(self.recover if pruned else ()), *self.quantized[shape.quantized])

    def first(self) -> Iterator[Shape]:
        """Yield what is tried first: nothing pruned, each way alone, then all of them."""
        fast = next(iter(self.quantized))
        half = min(self.widths, key=lambda width: abs(width - HALF_WIDTH))
        yield (whole := Shape(1.0, self.blocks, self.steps, fast))
        ways = {"steps": 1, "width": half, "blocks": (self.blocks + 1) // 2}
        changed = {name: value for name, value in ways.items() if value != getattr(whole, name)}
        for name, value in changed.items():
            yield Shape(**{**vars(whole), name: value})
        if len(changed) > 1:
            yield Shape(**{**vars(whole), **changed})

    def all(self) -> Iterator[Shape]:
        """Yield every shape, those of which most is left first."""
        for width, blocks, steps in itertools.product(self.widths, range(self.blocks, 0, -1), range(self.steps, 0, -1)):
            yield from (Shape(width, blocks, steps, name) for name in self.quantized)


def space_of(
    source: Bundle, pruning: Pruning, quantized: Mapping[str, StageList], cache: Path, context: Context
) -> Space:
    """Find out what of a policy may be pruned, by trying.

    Args:
        quantized: How a pruned policy may be quantized: name -> stages.

    Raises:
        RecipeError: when nothing can be pruned; says why.
    """
    refused: list[str] = []

    def attempt(name: str, **options: Any) -> Bundle | None:
        (stage,) = transforms(({name: options},))
        try:
            stage.check(source, None)
            return cached_transform(stage, source, cache, context).bundle
        except NOT_POSSIBLE as error:
            refused.append(f"{name}: {error.message}")
            return None

    step = (1 - pruning.least) / (WIDTHS - 1)
    widths = tuple(round(1 - step * number, 4) for number in range(WIDTHS))
    half = min(widths, key=lambda width: abs(width - HALF_WIDTH))
    narrow = [width for width in reversed(widths) if half <= width < 1]

    def can_reach(width: float) -> bool:
        """Say whether so much can go; a result that falls a little short would be the same at all smaller widths."""
        made = attempt("prune.structured", ratio=(ratio := round(1 - width, 4)))
        return made is not None and made.manifest.made_by[PRUNED_KEY]["reached"] >= ratio

    works = next((width for width in narrow if can_reach(width)), 1.0)
    widths = widths if works == half else tuple(width for width in widths if width >= works)
    ends = attempt("prune.depth", blocks=2, rank="even") or attempt("prune.depth", blocks=1, rank="even")
    steps = max(step.repeat for step in source.manifest.program)
    fewer = attempt("prune.steps", to=1) if steps > 1 else None
    space = Space(widths, _longest(ends) if ends else 1, steps if fewer else 1, quantized, pruning.recover)
    if space.is_empty:
        raise RecipeError(f"Nothing of {source.manifest.name} can be pruned. {' '.join(refused)}", "leave out --trials")
    return space


def _upwards(share: float) -> float:
    """Return a share with four decimals that is not smaller, so that as many blocks go."""
    return math.ceil(share * 1e4 - 1e-6) / 1e4


def _longest(ends: Bundle) -> int:
    """Return the length of the longest stack, of which the first and the last block (or one of two) were kept."""
    kept = [edit.keep for edit in read_edits(ends) if edit.axis == BLOCKS]
    return max(numbers[-1] + 1 if len(numbers) > 1 else 2 for numbers in kept)


def quantizations(candidates: Mapping[str, StageList]) -> dict[str, StageList]:
    """Return the candidates that say how a pruned policy may be quantized.

    Plans that change modules are not quantizations, and those that name layers are of the whole policy.
    """
    return {
        name: stages
        for name, stages in candidates.items()
        if stages
        and all(stage.kind() == "quantize" and not stage.takes_modules for stage in transforms(stages))
        and not any((options or {}).get("exclude") for stage in stages for options in stage.values())
    }
