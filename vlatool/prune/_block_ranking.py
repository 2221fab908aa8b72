"""Importance of each block of a stack for the action."""

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
from vlatool.prune._action_gradients import action_gradients
from vlatool.runtime.policy import relative_error

if TYPE_CHECKING:
    from torch import nn

SEED = 0
StackId = tuple[str, str]
"""Identity of a stack of blocks: its graph and the name of the list."""
BlockId = tuple[str, str, int]
"""Identity of a block: its graph, the name of the stack, and its index there."""


class BlockRanking:
    """Effect of blocks on the action, on recorded observations."""

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
        """Yield the raw action of each observation as a tensor, with the state from earlier ones."""
        for passage in self._passages:
            yield passage.run(self._program, self._noise)[self._action]

    def errors(self, candidates: Sequence[BlockId], removed: Collection[BlockId]) -> dict[BlockId, float]:
        """Return the mean relative error of the actions without each candidate, in addition to the removed blocks."""
        with require("torch", "build").no_grad():
            reference = [action.numpy() for action in self.actions()]
            errors = {}
            for block in candidates:
                with self._forward_hooks({*removed, block}, lambda _: _replace_by_identity):
                    pairs = zip(self.actions(), reference, strict=True)
                    errors[block] = float(np.mean([relative_error(action.numpy(), whole) for action, whole in pairs]))
        return errors

    def cosine(self, candidates: Sequence[BlockId], _removed: Collection[BlockId]) -> dict[BlockId, float]:
        """Return the mean of 1 - cosine similarity between input and output of each block."""
        torch = require("torch", "build")
        rotations: dict[BlockId, list[float]] = {block: [] for block in candidates}

        def hook(block: BlockId) -> Any:
            def record(_module: Any, given: Any, named: Any, gives: Any) -> None:
                similar = torch.nn.functional.cosine_similarity(_block_input(given, named), first(gives), dim=-1)
                rotations[block].append(1 - float(similar.mean()))

            return record

        with torch.no_grad(), self._forward_hooks(candidates, hook):
            for _ in self.actions():
                pass
        return {block: float(np.mean(shares)) if shares else 0.0 for block, shares in rotations.items()}

    def gate(self, candidates: Sequence[BlockId], _removed: Collection[BlockId]) -> dict[BlockId, float]:
        """Return the expected squared change of the action when a block's contribution is scaled.

        With a gate g of 1 on the contribution, ``x + g (block(x) - x)``, it is the mean of ``(d(v . action)/dg)^2``
        over random directions v: the diagonal of the Fisher information for an action with Gaussian noise.
        """
        torch = require("torch", "build")
        gates = {block: torch.ones((), requires_grad=True) for block in candidates}

        def hook(block: BlockId) -> Any:
            def scale(_module: Any, given: Any, named: Any, gives: Any) -> Any:
                stream = _block_input(given, named)
                mixed = stream + gates[block] * (first(gives) - stream)
                return (mixed, *gives[1:]) if isinstance(gives, tuple) else mixed

            return scale

        total = dict.fromkeys(candidates, 0.0)
        with self._forward_hooks(candidates, hook):
            for slopes in action_gradients(self.actions(), gates):
                for block, slope in slopes.items():
                    total[block] += float(slope) ** 2
        return total

    @contextlib.contextmanager
    def _forward_hooks(self, blocks: Collection[BlockId], hook: Callable[[BlockId], Any]) -> Iterator[None]:
        with contextlib.ExitStack() as hooks:
            for block in blocks:
                hooks.callback(self._blocks[block].register_forward_hook(hook(block), with_kwargs=True).remove)
            yield


def _block_input(given: Any, named: Any) -> Any:
    """Return the residual stream into a block: its first argument."""
    return given[0] if given else next(iter(named.values()))


def _replace_by_identity(_module: Any, given: Any, named: Any, gives: Any) -> Any:
    """Replace the output of a removed block by its input; additional outputs stay."""
    stream = _block_input(given, named)
    if first(gives).shape != stream.shape:
        raise SourceError(
            f"A block maps {list(stream.shape)} to {list(first(gives).shape)}: without it, shapes would not fit.",
            "exclude its stack: --exclude NAME",
        )
    return (stream, *gives[1:]) if isinstance(gives, tuple) else stream
