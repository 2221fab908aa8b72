"""What methods share that set single weights to zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, require
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.module.episode_context import passages
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.module.zeros import zero_share
from vlatool.prune._last import last_layers
from vlatool.prune._products import is_product, looking
from vlatool.prune._selection import Selection, protected_parts
from vlatool.runtime.engine import usable_engines
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import Tensor, nn

PATTERNS = {"2:4": (2, 4), "4:8": (4, 8)}
"""Pattern -> how many of how many neighbours along the inputs stay."""
Pattern = Literal["unstructured", "2:4", "4:8"]
SHOWN = 8
"""Layers that are named; the others are counted."""
PROTECTED = ("embed", "norm", "head", "action")
"""Parts of names of layers that stay dense unless --include names them."""


class Sparse(ModuleStage):
    """Sets single weights of Linear and convolution layers to zero; shapes stay, and so does the time on processors."""

    leaves_zeros: ClassVar[bool] = True
    looks: ClassVar[bool] = True
    """Whether the method looks at what layers are given."""

    ratio: float = Field(0.5, gt=0, lt=1, description="share of each layer's weights that becomes zero")
    pattern: Pattern = Field(
        "unstructured",
        description="2:4 is for sparse tensor cores (NVIDIA Ampere and later); it keeps half",
    )
    samples: int = Field(32, ge=1, description="recorded observations to look at")
    include: tuple[str, ...] = Field((), description="globs of layers; all but embeddings and heads when empty")
    exclude: tuple[str, ...] = Field((), description="globs of layers to leave as they are")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Set weights to zero.

        Raises:
            RecipeError: when no layer is chosen, or the ratio is not that of the pattern.
        """
        check_pattern(self.pattern, self.ratio)
        found = sparse_layers(modules, source, self.include, self.exclude)
        context.messages.extend(found.told())
        layers = found.chosen
        context.messages.extend(unrecorded_note(source, self.samples) if self.looks else ())
        given = self._given(layers, modules, source, context) if self.looks else {}
        for number, (name, layer) in enumerate(layers.items()):
            context.progress(f"pruning {name}", number / len(layers))
            flat = layer.weight.detach().reshape(len(layer.weight), -1)
            layer.weight.data = self.sparse(flat, given.get(name)).reshape(layer.weight.shape).to(layer.weight.dtype)
        return ModuleChanges()

    def sparse(self, weight: Tensor, given: Tensor | None) -> Tensor:
        """Return a weight with zeros.

        Args:
            weight: (outputs, inputs).
            given: Gram matrix of what the layer is given, (inputs, inputs), where the method looks at it.
        """
        raise NotImplementedError(self.name())

    def goes(self, score: Tensor, rows: bool) -> Tensor:
        """Return which weights go: those of the least scores.

        Args:
            score: (outputs, inputs).
            rows: Whether weights compete within their row, rather than in the whole layer.
        """
        return least(score, self.pattern, self.ratio, rows=rows)

    def lines(self, made: Bundle) -> tuple[str, ...]:
        """Say how many weights are zero, and which engine gains by it."""
        return (*zeros_told(made, self.pattern), *super().lines(made))

    def _given(
        self, layers: Mapping[str, Any], modules: Mapping[str, nn.Module], source: Bundle, context: Context
    ) -> dict[str, Tensor]:
        """Return name of a layer -> mean of x xT over what it is given on recorded observations."""
        program = BatchedProgram(source.manifest.program, modules)
        noise = draw_noise(program.noise, 1, np.random.default_rng(0))
        sums: dict[str, Any] = {}
        counts: dict[str, int] = {}
        names = {id(layer.weight): name for name, layer in layers.items()}

        def look(weight: Tensor, rows: Tensor) -> None:
            if name := names.get(id(weight)):
                sums[name] = sums.get(name, 0) + rows.double().T @ rows.double()
                counts[name] = counts.get(name, 0) + len(rows)

        recorded = passages(source, program, noise, self.samples, 1)
        with require("torch", "build").no_grad(), looking(look):
            for number, passage in enumerate(recorded):
                context.progress("looking at what layers are given", number / len(recorded))
                passage.run(program, noise)
        return {name: total / counts[name] for name, total in sums.items()}


def check_pattern(pattern: Pattern, ratio: float) -> None:
    """Refuse a ratio that is not that of the pattern.

    Raises:
        RecipeError: saying so.
    """
    if pattern != "unstructured" and ratio != 0.5:
        raise RecipeError(f"The pattern {pattern} keeps half of the weights.", "leave --ratio out")


def least(score: Tensor, pattern: Pattern, share: float, *, rows: bool) -> Tensor:
    """Return which elements have the least scores; of equal ones the first.

    Args:
        score: (outputs, inputs).
        pattern: Whether they compete with their neighbours alone.
        share: Of the elements (rounded: of the neighbours).
        rows: Without a pattern: whether they compete within their row, rather than in the whole layer.
    """
    torch = require("torch", "build")
    if pattern != "unstructured":
        _, of = PATTERNS[pattern]
        padded = torch.nn.functional.pad(score, (0, -score.shape[1] % of), value=torch.inf)
        ranks = padded.reshape(len(score), -1, of).argsort(dim=-1, stable=True).argsort(dim=-1)
        whole = (ranks < round(share * of)).reshape(len(score), -1)
        within: Tensor = whole[:, : score.shape[1]]
        return within
    flat = score if rows else score.reshape(1, -1)
    count = round(flat.shape[1] * share)
    ranks = flat.argsort(dim=1, stable=True).argsort(dim=1)
    smallest: Tensor = (ranks < count).reshape(score.shape)
    return smallest


def zeros_told(made: Bundle, pattern: Pattern) -> tuple[str, str]:
    """Say how many weights of a bundle are zero, and which engine gains by it."""
    engines = usable_engines().values()
    gains = [engine.title for engine in engines if pattern in engine.sparse]
    others = " and ".join(engine.title for engine in engines)
    return (
        f"{zero_share(made):.1%} of the weights are zero; no tensor is smaller",
        f"faster in {', '.join(gains)}" if gains else f"{others} multiply zeros like other numbers: nothing is "
        "faster (measure it: vlatool compare). 2:4 is for sparse tensor cores; for speed: vlatool prune structured",
    )  # fmt: skip


@dataclass(frozen=True)
class Layers:
    """Linear and convolution layers by name; ``GRAPH.name`` in a policy of several graphs.

    Args:
        chosen: Whose weights may become zero.
        dense: Names of the others.
    """

    chosen: dict[str, Any]
    dense: tuple[str, ...]

    def told(self) -> tuple[str, ...]:
        """Say which layers stay dense, where some do."""
        some, more = ", ".join(self.dense[:SHOWN]), len(self.dense) - SHOWN
        return (
            f"left dense: {some}{f' and {more} more' if more > 0 else ''} (--include names what else may go)",
        ) * bool(self.dense)


def sparse_layers(
    modules: Mapping[str, nn.Module], source: Bundle, include: tuple[str, ...], exclude: tuple[str, ...]
) -> Layers:
    """Choose whose weights become zero; embeddings, norms, heads and what gives the action stay, unless included.

    A layer that several graphs share is the first one's, and so is a weight of several layers.

    Raises:
        RecipeError: when a pattern matches none, or there is none.
    """
    found: dict[int, tuple[tuple[str, str], Any]] = {}
    for graph, module in modules.items():
        for name, part in module.named_modules():
            if is_product(part):
                found.setdefault(id(part.weight), ((graph, name), part))
    named = dict(found.values())
    full = {(graph, name): f"{graph}.{name}" if len(modules) > 1 else name for graph, name in named}
    selection = Selection(include, exclude, PROTECTED, protected_parts(source.manifest.parts, PROTECTED))
    selection.check([*full.values(), *(name for _, name in named)], "layer")
    acts = last_layers(modules, source, named.values()) if not include else set()
    chosen = {
        full[place]: part
        for place, part in named.items()
        if id(part) not in acts and selection.has({place[1], full[place]})
    }
    if not chosen:
        raise RecipeError(f"{source.manifest.name} has no layer to prune.", "look at --include and --exclude")
    dense = [name for place, name in full.items() if name not in chosen]
    return Layers(chosen, tuple(dense))
