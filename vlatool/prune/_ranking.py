"""How much the action needs each block of a stack."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError, require
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.module.blocks import first, stacks
from vlatool.module.episode_context import LEADING_OBSERVATIONS, passages
from vlatool.prune._slopes import slopes_of
from vlatool.runtime.policy import relative_error

if TYPE_CHECKING:
    from torch import nn

SEED = 0
Stack = tuple[str, str]
"""Blocks one behind the other: their graph and the name of the list."""
Place = tuple[str, str, int]
"""A block: its graph, the name of the stack, and its number there."""


class Ranking:
    """What the action loses without some blocks, on recorded observations.

    Args:
        modules: Graph name -> module.
        source: For the program and the encoding of observations.
        samples: Observations at most.
    """

    def __init__(self, modules: Mapping[str, nn.Module], source: Bundle, samples: int) -> None:
        self._program = BatchedProgram(source.manifest.program, modules)
        self._action = source.manifest.spec.action.name
        self._noise = draw_noise(self._program.noise, 1, np.random.default_rng(SEED))
        self._passages = passages(source, self._program, self._noise, samples, LEADING_OBSERVATIONS)
        self._blocks = {
            (graph, name, number): block
            for graph, module in modules.items()
            for name, stack in stacks(module)
            for number, block in enumerate(stack)
        }

    def actions(self) -> Iterator[Any]:
        """Yield the raw action of each observation as a tensor, with what is kept of those before it."""
        for passage in self._passages:
            yield passage.run(self._program, self._noise)[self._action]

    def errors(self, candidates: Sequence[Place], removed: Collection[Place]) -> dict[Place, float]:
        """Return the mean relative error of the actions without each candidate, in addition to what is removed."""
        with require("torch", "build").no_grad():
            wanted = [action.numpy() for action in self.actions()]
            found = {}
            for place in candidates:
                with self._hooked({*removed, place}, lambda _: _passes_on):
                    pairs = zip(self.actions(), wanted, strict=True)
                    found[place] = float(np.mean([relative_error(action.numpy(), whole) for action, whole in pairs]))
        return found

    def cosine(self, candidates: Sequence[Place], _removed: Collection[Place]) -> dict[Place, float]:
        """Return 1 - cosine similarity between what each block is given and what it gives, as a mean."""
        torch = require("torch", "build")
        turned: dict[Place, list[float]] = {place: [] for place in candidates}

        def looking(place: Place) -> Any:
            def look(_module: Any, given: Any, named: Any, gives: Any) -> None:
                similar = torch.nn.functional.cosine_similarity(_stream(given, named), first(gives), dim=-1)
                turned[place].append(1 - float(similar.mean()))

            return look

        with torch.no_grad(), self._hooked(candidates, looking):
            for _ in self.actions():
                pass
        return {place: float(np.mean(shares)) if shares else 0.0 for place, shares in turned.items()}

    def gate(self, candidates: Sequence[Place], _removed: Collection[Place]) -> dict[Place, float]:
        """Return the expected square of what the action moves by when a block's contribution is scaled.

        With a gate g of 1 on the contribution, ``x + g (block(x) - x)``, it is the mean of ``(d(v . action)/dg)^2``
        over random directions v: the diagonal of the Fisher information for an action with Gaussian noise.
        """
        torch = require("torch", "build")
        gates = {place: torch.ones((), requires_grad=True) for place in candidates}

        def gated(place: Place) -> Any:
            def scale(_module: Any, given: Any, named: Any, gives: Any) -> Any:
                stream = _stream(given, named)
                mixed = stream + gates[place] * (first(gives) - stream)
                return (mixed, *gives[1:]) if isinstance(gives, tuple) else mixed

            return scale

        total = dict.fromkeys(candidates, 0.0)
        with self._hooked(candidates, gated):
            for slopes in slopes_of(self.actions(), gates):
                for place, slope in slopes.items():
                    total[place] += float(slope) ** 2
        return total

    @contextlib.contextmanager
    def _hooked(self, places: Collection[Place], hook: Callable[[Place], Any]) -> Iterator[None]:
        handles = [self._blocks[place].register_forward_hook(hook(place), with_kwargs=True) for place in places]
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()


def _stream(given: Any, named: Any) -> Any:
    """Return what passes through a block: its first argument."""
    return given[0] if given else next(iter(named.values()))


def _passes_on(_module: Any, given: Any, named: Any, gives: Any) -> Any:
    """Take the place of a block that is removed: what it is given, beside what else it gives."""
    stream = _stream(given, named)
    if first(gives).shape != stream.shape:
        raise SourceError(
            f"A block gives {list(first(gives).shape)} for {list(stream.shape)}: without it, shapes would not fit.",
            "leave its stack out: --exclude NAME",
        )
    return (stream, *gives[1:]) if isinstance(gives, tuple) else stream
