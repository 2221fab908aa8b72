"""A policy's program in torch: batches of observations, with gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError, require
from vlatool.files.printable import message_of
from vlatool.module.factory import map_user_exceptions
from vlatool.module.failures import remedy_for
from vlatool.module.modules import outputs_of
from vlatool.module.unit_removal import RETRACE
from vlatool.runtime.program import draw

if TYPE_CHECKING:
    from torch import Tensor, nn


Run = Callable[[Mapping[str, "Tensor"], Mapping[str, "Tensor"]], dict[str, "Tensor"]]
PATH, TURN = "path.", "turn."
"""Prefix of the names of what a loop carries, all turns of it; name of the number of a turn."""
FITS = (
    "correct the spec in policy.yaml if the policy never gets such an input, or forward() if it may; "
    "docs/guides/your-own-policy.md says what forward() is given"
)
TOLERANCE = 1e-3
"""Relative and absolute difference that a different order of additions may cause."""


class BatchedProgram:
    """Runs the steps of a program over torch modules, as ``vlatool.runtime.program`` does over graphs.

    Values have the batch in front: where the program says ``[1, 50, 7]``, a batch of B has ``(B, 50, 7)``. Modules that
    take one observation alone, such as those with ``reshape(1, ...)``, are run row by row. Kept values are given and
    returned with the batch before their whole shape: ``(B, 2, 1, 128)`` where the program says ``[2, 1, 128]``; modules
    get them with the batch instead of an axis of size 1, whichever they take. They begin at zero where none are given,
    as they do after ``reset``.

    Attributes:
        noise: what the program draws, value name -> shape and distribution.
        kept: what the program keeps from run to run, value name -> shape and dtype.
        loop: the first step that runs several times and carries values from turn to turn; None where there is none.
    """

    def __init__(self, steps: Iterable[ProgramStep], modules: Mapping[str, nn.Module]) -> None:
        self.steps = tuple(steps)
        self.modules = modules
        self._batches: bool | None = None
        self._axis = 0
        self._retraced: dict[tuple[str, int], nn.Module] = {}
        self.noise = {name: wanted for step in self.steps for name, wanted in step.noise.items()}
        self.kept = {name: wanted for step in self.steps for name, wanted in step.keep.items()}
        self.loop = next((step for step in self.steps if step.repeat > 1 and step.carry), None)

    def run(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Run all steps.

        Args:
            inputs: encoded inputs, value name -> (B, ...).
            noise: what the program draws, value name -> (B, ...); with it what was kept of the run before, if it was.

        Returns:
            Every value, of the inputs too.

        Raises:
            SourceError: when a module fails, or gives another number of outputs than the program says.
        """
        self.look(inputs, noise)
        return self._by_rows(self._run, inputs, noise)

    def kept_of(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return what is kept of a run for the next one."""
        return {name: values[name] for name in self.kept}

    def path(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Run all steps, as ``run`` does; what the turns of ``loop`` carry is kept, too.

        Returns:
            Every value, and under ``PATH + name`` what a carried value was before each turn and after the last one,
            (B, turns + 1, ...).
        """
        self.look(inputs, noise)
        return self._by_rows(partial(self._run, keeps_path=True), inputs, noise)

    def turn(self, inputs: Mapping[str, Tensor], start: Mapping[str, Tensor], turns: Tensor) -> dict[str, Tensor]:
        """Run what comes before ``loop``, and one of its turns, each row its own; ``look`` at a batch first.

        Args:
            inputs: encoded inputs, value name -> (B, ...).
            start: what the turn is given of the carried values, value name -> (B, ...).
            turns: number of the turn of each row, from 0, (B,) int64.

        Returns:
            Every value after that turn.
        """
        return self._by_rows(self._turn, inputs, {**start, TURN: turns})

    def _by_rows(self, run: Run, inputs: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Run a batch at once where the modules take batches, and row by row where they do not."""
        size = len(next(iter(inputs.values())))
        return run(inputs, others) if size == 1 or self._batches else _run_single_rows(run, inputs, others, size)

    def look(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> None:
        """Find out with a first batch whether the modules take batches; where runs are changed, look before that."""
        if len(next(iter(inputs.values()))) > 1 and self._batches is None:
            self._batches = self._takes_batches(inputs, noise)

    def runs_at_once(self, size: int) -> bool:
        """Return whether a batch of that size runs at once, and not row by row; ``look`` at one before."""
        return size > 1 and bool(self._batches)

    def modules_for(self, size: int) -> dict[str, nn.Module]:
        """Return what runs for a batch of that size: graph name -> module, traced anew where it must be."""
        return {graph: self._module(graph, size if self.runs_at_once(size) else 1) for graph in self.modules}

    def _takes_batches(self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor]) -> bool:
        """Say whether two rows together give what each gives alone; of what is kept, too, once it is not zero."""
        drawn = {name: value for name, value in noise.items() if name not in self.kept}
        with require("torch", "build").no_grad():
            first = _run_single_rows(self._run, inputs, drawn, 2)
            again = {**drawn, **self.kept_of(first)}
            wanted = [(drawn, first), *([(again, _run_single_rows(self._run, inputs, again, 2))] if self.kept else [])]
            sizes = [len(kept["shape"]) for kept in self.kept.values()]
            for self._axis in range(max(sizes, default=1)):
                if all(self._is_same(_rows(inputs, 0, 2), others, values) for others, values in wanted):
                    return True
        return False

    def _is_same(
        self, inputs: Mapping[str, Tensor], others: Mapping[str, Tensor], wanted: Mapping[str, Tensor]
    ) -> bool:
        """Say whether a batch gives what is wanted of it."""
        try:
            both = self._run(inputs, _rows(others, 0, 2))
        except SourceError:
            return False
        close = require("torch", "build").allclose
        return all(both[name].shape == value.shape and close(both[name].float(), value.float(), TOLERANCE, TOLERANCE)
                   for name, value in wanted.items())  # fmt: skip

    def _run(
        self, inputs: Mapping[str, Tensor], noise: Mapping[str, Tensor], *, keeps_path: bool = False
    ) -> dict[str, Tensor]:
        size = len(next(iter(inputs.values())))
        values = {**inputs, **noise, **self._kept_inputs(noise, size)}
        for step in self.steps:
            carried = tuple(step.carry.values()) if keeps_path and step is self.loop else ()
            path = {name: [values[name]] for name in carried}
            for turn in range(step.repeat):
                values |= self._schedule_values(step, turn, values)
                values |= self._step(step, values)
                for name, before in path.items():
                    before.append(values[name])
            values |= {PATH + name: require("torch", "build").stack(points, 1) for name, points in path.items()}
        return values | {name: self._kept_output(name, values[name], size) for name in self.kept}

    def _turn(self, inputs: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> dict[str, Tensor]:
        torch = require("torch", "build")
        turns, values = start[TURN], {**inputs, **start, **self._kept_inputs(start, len(start[TURN]))}
        for step in self.steps:
            if step is self.loop:
                for name, numbers in step.schedule.items():
                    values[name] = torch.tensor(numbers, dtype=_dtype_of(numbers))[turns]
                return values | self._step(step, values)
            for turn in range(step.repeat):
                values |= self._schedule_values(step, turn, values)
                values |= self._step(step, values)
        raise ValueError("the program has no loop")

    def _kept_inputs(self, others: Mapping[str, Tensor], size: int) -> dict[str, Tensor]:
        """Return what is kept as modules take it; as it is after ``reset`` where it is not given."""
        torch, fed = require("torch", "build"), dict[str, Any]()
        for name, kept in self.kept.items():
            dtype = getattr(torch, kept.get("dtype", "float32"))
            value = others[name] if name in others else torch.zeros((size, *kept["shape"]), dtype=dtype)
            axis = self._batch_axis(name) if size > 1 else 0
            fed[name] = value.squeeze(axis + 1).movedim(0, axis) if size > 1 else value[0]
        return fed

    def _kept_output(self, name: str, value: Tensor, size: int) -> Tensor:
        """Return what a module gave for a kept value, with the batch before its shape."""
        shape, axis = list(self.kept[name]["shape"]), self._batch_axis(name) if size > 1 else 0
        wanted = [*shape[:axis], size, *shape[axis + 1 :]] if size > 1 else shape
        if list(value.shape) != wanted:
            raise SourceError(
                f"The kept value '{name}' is {list(value.shape)}; the program declares {wanted}.",
                "declare under 'keep' what the graph gives",
            )
        dtype = getattr(require("torch", "build"), self.kept[name].get("dtype", "float32"))
        value = value.to(dtype) if value.is_floating_point() and dtype.is_floating_point else value
        return value.movedim(axis, 0).unsqueeze(axis + 1) if size > 1 else value[None]

    def _batch_axis(self, name: str) -> int:
        """Return the axis of a kept value in which a batch is: the one that modules take, or the next of size 1."""
        shape = self.kept[name]["shape"]
        ones = [axis for axis, size in enumerate(shape) if size == 1]
        if not ones:
            raise SourceError(
                f"The kept value '{name}' has no axis for a batch: {list(shape)}.",
                "declare it under 'keep' with an axis of 1 in front",
            )
        return next((axis for axis in ones if axis >= self._axis), ones[-1])

    def _schedule_values(self, step: ProgramStep, turn: int, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the numbers of one turn for each row."""
        torch, size = require("torch", "build"), len(next(iter(values.values())))
        return {name: torch.full((size,), numbers[turn], dtype=_dtype_of(numbers))
                for name, numbers in step.schedule.items()}  # fmt: skip

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


def _dtype_of(numbers: Sequence[float]) -> Any:
    """Return the dtype in which numbers of a schedule are given."""
    torch = require("torch", "build")
    return torch.int64 if all(isinstance(number, int) for number in numbers) else torch.float32


def _run_single_rows(
    run: Run, inputs: Mapping[str, Tensor], others: Mapping[str, Tensor], count: int
) -> dict[str, Tensor]:
    """Return what the first rows give, each for itself, whatever its dtype: autocast refuses float16 on a processor."""
    torch = require("torch", "build")
    rows = [run(_rows(inputs, row, row + 1), _rows(others, row, row + 1)) for row in range(count)]
    with torch.autocast("cpu", enabled=False):
        return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}


def _rows(values: Mapping[str, Tensor], start: int, end: int) -> dict[str, Tensor]:
    return {name: value[start:end] for name, value in values.items()}


def run_module(module: nn.Module, step: ProgramStep, arguments: list[Tensor]) -> list[Tensor]:
    """Run a user's module and return its outputs in the order of the step's ``gives``.

    Raises:
        SourceError: when it fails, or gives something else than the tensors that the program names.
    """
    torch = require("torch", "build")
    try:
        with map_user_exceptions("the policy's forward()"):
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
            _remedy_of_casting(error) or remedy_for(error) or FITS,
        ) from error
    outputs = outputs_of(result, step)
    for name, value in zip(step.gives, outputs, strict=True):
        if not isinstance(value, torch.Tensor):
            raise SourceError(
                f"The module gives a {type(value).__name__} for '{name}'; wanted a tensor.",
                "return a tensor, or a tuple of tensors in the order of 'gives'",
            )
    return outputs


def _remedy_of_casting(error: Exception) -> str:
    """Return the remedy where a module mixes what a training casts to bfloat16 with what it leaves in float32."""
    torch = require("torch", "build")
    cast = torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")
    about = any(word in message_of(error) for word in ("dtype", "autocast"))
    return "train in float32: --precision float32" if cast and about else ""


def draw_noise(noise: Mapping[str, Mapping[str, Any]], size: int, random: np.random.Generator) -> dict[str, Tensor]:
    """Draw a batch of a program's ``noise``: value name -> shape and distribution, as the program has them."""
    torch = require("torch", "build")
    batches = {name: {**wanted, "shape": (size, *wanted["shape"][1:])} for name, wanted in noise.items()}
    return {
        name: torch.from_numpy(draw(wanted, random)).to(torch.get_default_device()) for name, wanted in batches.items()
    }


def no_gradient_error(fix: str) -> SourceError:
    """Return the error of a policy whose action does not depend on its weights."""
    return SourceError(
        "The policy gives its action without gradients: forward() detaches it, or runs under torch.no_grad().", fix
    )
