"""The outputs of blocks of a policy while it runs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vlatool.errors import require
from vlatool.module.batched_program import BatchedProgram
from vlatool.module.blocks import first

if TYPE_CHECKING:
    from torch import Tensor

BlockName = tuple[str, str]
"""A block: its graph, and the name of the module."""


@dataclass(frozen=True)
class Form:
    """What a block gives for one observation.

    Args:
        calls: how often it runs in an inference.
        shape: shape of what it gives each time; None when that is not a tensor of floats, or differs from call to call.
        channels_first: whether the second axis, and not the last one, is that of the features.
    """

    calls: int
    shape: tuple[int, ...] | None = None
    channels_first: bool = False

    @property
    def features(self) -> tuple[int, ...]:
        """The shape with the features last."""
        shape = self.shape or ()
        return (shape[0], *shape[2:], shape[1]) if self.channels_first else shape


class Taps:
    """Records the outputs of blocks."""

    def __init__(self, program: BatchedProgram, blocks: Iterable[BlockName]) -> None:
        self.program = program
        self._given: dict[BlockName, list[Any]] = {block: [] for block in blocks}
        self._channels_first: set[BlockName] = set()

    @contextlib.contextmanager
    def open(self, size: int) -> Iterator[None]:
        """Keep what is given while a batch of that size runs once within this block."""
        modules = self.program.modules_for(size)
        with contextlib.ExitStack() as hooks:
            for (graph, name), given in self._given.items():
                given.clear()
                block = modules[graph].get_submodule(name)
                hooks.callback(block.register_forward_hook(_output_hook(given)).remove)
            yield

    def forms(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> dict[BlockName, Form]:
        """Run one observation, and return what each block gives."""
        modules = self.program.modules_for(1)
        with require("torch", "build").no_grad(), self.open(1):
            self.program.run(inputs, noise)
        forms = {
            (graph, name): _form(given, modules[graph].get_submodule(name))
            for (graph, name), given in self._given.items()
        }
        self._channels_first = {block for block, form in forms.items() if form.channels_first}
        return forms

    def take(self, size: int) -> dict[BlockName, Tensor]:
        """Return what was kept of a batch, (B * calls, ..., features), float32; the calls of a row follow each other.

        Blocks that gave nothing are left out.
        """
        together = self.program.runs_at_once(size)
        found = {block: self._join(block, given, together) for block, given in self._given.items() if given}
        for given in self._given.values():
            given.clear()
        return found

    def _join(self, block: BlockName, given: list[Any], together: bool) -> Tensor:
        torch = require("torch", "build")
        values: Tensor = torch.stack(given, 1).flatten(0, 1) if together else torch.cat(given)
        values = values.movedim(1, -1) if block in self._channels_first else values
        return values.float()


def _output_hook(given: list[Any]) -> Any:
    def keep(_module: Any, _arguments: Any, gives: Any) -> None:
        given.append(first(gives))

    return keep


def _form(given: list[Any], block: Any) -> Form:
    torch = require("torch", "build")
    floats = all(isinstance(value, torch.Tensor) and value.is_floating_point() for value in given)
    shapes = {tuple(value.shape) for value in given} if floats else set()
    if len(shapes) != 1:
        return Form(len(given))
    (shape,) = shapes
    return Form(len(given), shape, _is_convolutional(block, shape))


def _is_convolutional(block: Any, shape: tuple[int, ...]) -> bool:
    """Say whether a block convolves, and gives as many channels; the classes of a traced one's layers do not say."""
    weights = [tuple(value.shape) for name, value in block.named_parameters() if name.endswith("weight")]
    return len(shape) > 2 and any(len(weight) == len(shape) and weight[0] == shape[1] for weight in weights)
