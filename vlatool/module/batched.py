"""A policy's program in torch: batches of observations, with gradients."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError, require
from vlatool.files.printable import message_of
from vlatool.module.cut import RETRACE
from vlatool.module.factory import exits_caught
from vlatool.module.failures import remedy_for
from vlatool.module.modules import outputs_of
from vlatool.runtime.program import draw

if TYPE_CHECKING:
    from torch import Tensor, nn


SAME = 1e-3
"""Relative and absolute difference that the order of additions makes."""


class BatchedProgram:
    """Runs the steps of a program over torch modules, as ``vlatool.runtime.program`` does over graphs.

    Values have the batch in front: where the program says ``[1, 50, 7]``, a batch of B has ``(B, 50, 7)``. Kept values
    begin at zero in every run, as they do after ``reset``. Modules that take one observation alone, such as those with
    ``reshape(1, ...)``, are run row by row.

    Args:
        steps: As in the manifest.
        modules: Graph name -> module.
    """

    def __init__(self, steps: Iterable[ProgramStep], modules: Mapping[str, nn.Module]) -> None:
        self.steps = tuple(steps)
        self.modules = modules
        self._batches: bool | None = None
        self._retraced: dict[tuple[str, int], nn.Module] = {}
        self.noise = {name: wanted for step in self.steps for name, wanted in step.noise.items()}

    def run(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Run all steps.

        Args:
            inputs: Encoded inputs, value name -> (B, ...).
            noise: What the program draws, value name -> (B, ...).

        Returns:
            Every value, of the inputs too.

        Raises:
            SourceError: when a module fails, or gives another number of outputs than the program says.
        """
        torch = require("torch", "build")
        size = len(next(iter(inputs.values())))
        self.look(inputs, noise)
        if size == 1 or self._batches:
            return self._run(inputs, noise)
        rows = [self._run(_rows(inputs, row, row + 1), _rows(noise, row, row + 1)) for row in range(size)]
        return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}

    def look(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> None:
        """Find out with a first batch whether the modules take batches; where runs are changed, look before that."""
        if len(next(iter(inputs.values()))) > 1 and self._batches is None:
            self._batches = self._takes_batches(inputs, noise)

    def together(self, size: int) -> bool:
        """Return whether a batch of that size runs at once, and not row by row; ``look`` at one before."""
        return size > 1 and bool(self._batches)

    def modules_for(self, size: int) -> dict[str, nn.Module]:
        """Return what runs for a batch of that size: graph name -> module, traced anew where it must be."""
        return {graph: self._module(graph, size if self.together(size) else 1) for graph in self.modules}

    def _takes_batches(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> bool:
        """Say whether two rows together give what each gives alone."""
        torch = require("torch", "build")
        with torch.no_grad():
            alone = [self._run(_rows(inputs, row, row + 1), _rows(noise, row, row + 1)) for row in range(2)]
            try:
                both = self._run(_rows(inputs, 0, 2), _rows(noise, 0, 2))
            except SourceError:
                return False
        wanted = {name: torch.cat([row[name] for row in alone]) for name in alone[0]}
        return all(
            both[name].shape == value.shape and torch.allclose(both[name].float(), value.float(), SAME, SAME)
            for name, value in wanted.items()
        )

    def _run(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> dict[str, Tensor]:
        torch = require("torch", "build")
        size = len(next(iter(inputs.values())))
        values = {**inputs, **noise}
        for step in self.steps:
            for name, kept in step.keep.items():
                dtype = getattr(torch, kept.get("dtype", "float32"))
                values[name] = torch.zeros((size, *kept["shape"][1:]), dtype=dtype)
        for step in self.steps:
            for turn in range(step.repeat):
                for name, numbers in step.schedule.items():
                    whole = all(isinstance(number, int) for number in numbers)
                    values[name] = torch.full((size,), numbers[turn], dtype=torch.int64 if whole else torch.float32)
                values |= self._step(step, values)
        return values

    def _module(self, graph: str, size: int) -> nn.Module:
        """Return the module of a graph for a batch of that size: a traced one may be made for one size alone."""
        retrace = getattr(self.modules[graph], RETRACE, None)
        if retrace is None or size == 1:
            return self.modules[graph]
        if (graph, size) not in self._retraced:
            self._retraced[graph, size] = retrace(size)
        return self._retraced[graph, size]

    def _step(self, step: ProgramStep, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return what one run of a step's module changes."""
        size = len(values[next(iter(step.feeds.values()))])
        gives = run_module(self._module(step.graph, size), step, [values[name] for name in step.feeds.values()])
        changed = dict(zip(step.gives.values(), gives, strict=True))
        for source, target in step.carry.items():
            changed[target] = changed[source] if source in changed else values[source]
        return changed


def _rows(values: Mapping[str, Tensor], start: int, end: int) -> dict[str, Tensor]:
    return {name: value[start:end] for name, value in values.items()}


def run_module(module: nn.Module, step: ProgramStep, arguments: list[Tensor]) -> list[Tensor]:
    """Run a user's module and return its outputs in the order of the step's ``gives``.

    Raises:
        SourceError: when it fails, or gives something else than the tensors that the program names.
    """
    torch = require("torch", "build")
    try:
        with exits_caught("the policy's forward()"):
            result = module(*arguments)
    except SourceError:
        raise
    except Exception as error:  # the seam: the user's module may raise anything
        given = zip(step.feeds, arguments, strict=True)
        shapes = ", ".join(
            f"{name} {list(value.shape)} {str(value.dtype).removeprefix('torch.')}" for name, value in given
        )
        raise SourceError(
            f"The policy fails on an observation that fits its spec: {type(error).__name__}: "
            f"{(message_of(error).splitlines() or [''])[0]} (given {shapes}).",
            remedy_for(error),
        ) from error
    outputs = outputs_of(result, step)
    for name, value in zip(step.gives, outputs, strict=True):
        if not isinstance(value, torch.Tensor):
            raise SourceError(
                f"The module gives a {type(value).__name__} for '{name}'; wanted a tensor.",
                "return a tensor, or a tuple of tensors in the order of 'gives'",
            )
    return outputs


def drawn(noise: Mapping[str, Mapping[str, Any]], size: int, random: np.random.Generator) -> dict[str, Tensor]:
    """Draw a batch of what a program draws.

    Args:
        noise: Value name -> shape and distribution, as the program has them.
        size: Of the batch.
        random: Where it is drawn from.
    """
    torch = require("torch", "build")
    batches = {name: {**wanted, "shape": (size, *wanted["shape"][1:])} for name, wanted in noise.items()}
    return {
        name: torch.from_numpy(draw(wanted, random)).to(torch.get_default_device()) for name, wanted in batches.items()
    }


def no_gradient(fix: str) -> SourceError:
    """Return the error of a policy whose action does not depend on its weights."""
    return SourceError(
        "The policy gives its action without gradients: forward() detaches it, or runs under torch.no_grad().", fix
    )
