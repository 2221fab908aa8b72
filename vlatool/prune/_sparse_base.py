"""Base of the methods that set individual weights to zero."""

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
from vlatool.prune._output_layers import output_layers
from vlatool.prune._product_observer import is_product_layer, observe_products
from vlatool.prune._selection import Selection
from vlatool.runtime.engine import usable_engines
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import Tensor, nn

PATTERNS = {"2:4": (2, 4), "4:8": (4, 8)}
"""Pattern -> number of kept weights, and of neighbours along the inputs that they are chosen from."""
Pattern = Literal["unstructured", "2:4", "4:8"]
MAX_NAMED = 8
"""Largest number of layers in a message; the others are counted."""
PROTECTED_WORDS = ("embed", "norm", "head", "action")
"""Words in the names of layers that stay dense unless --include names them."""


class SparsePruning(ModuleStage):
    """Sets individual weights of Linear and convolution layers to zero; shapes and latency on CPUs stay the same."""

    leaves_zeros: ClassVar[bool] = True
    uses_inputs: ClassVar[bool] = True
    """Whether the method needs the inputs of layers."""

    ratio: float = Field(0.5, gt=0, lt=1, description="share of each layer's weights that becomes zero")
    pattern: Pattern = Field(
        "unstructured", description="2:4 is for sparse tensor cores (NVIDIA Ampere and later); it keeps half"
    )
    samples: int = Field(32, ge=1, description="recorded observations to use")
    include: tuple[str, ...] = Field((), description="globs of layers; all but embeddings and heads when empty")
    exclude: tuple[str, ...] = Field((), description="globs of layers to leave as they are")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Set weights to zero."""
        check_pattern(self.pattern, self.ratio)
        selection = select_layers(modules, source, self.include, self.exclude)
        layers = selection.prunable
        moments = self._input_moments(layers, modules, source, context) if self.uses_inputs else {}
        for number, (name, layer) in enumerate(layers.items()):
            context.progress(f"pruning {name}", number / len(layers))
            flat = layer.weight.detach().reshape(len(layer.weight), -1)
            pruned = self.prune_weight(flat, moments.get(name))
            layer.weight.data = pruned.reshape(layer.weight.shape).to(layer.weight.dtype)
        unrecorded = unrecorded_note(source, self.samples) if self.uses_inputs else ()
        return ModuleChanges(messages=(*selection.describe(), *unrecorded))

    def prune_weight(self, weight: Tensor, moments: Tensor | None) -> Tensor:
        """Return a weight with zeros.

        Args:
            weight: (outputs, inputs).
            moments: Gram matrix of the inputs of the layer, (inputs, inputs), where the method needs it.
        """
        raise NotImplementedError(self.name())

    def pruned_mask(self, score: Tensor, rows: bool) -> Tensor:
        """Return the mask of weights to remove: those of the smallest scores.

        Args:
            score: (outputs, inputs).
            rows: Whether weights compete within their row instead of in the whole layer.
        """
        return smallest_mask(score, self.pattern, self.ratio, rows=rows)

    def summarize(self, pruned: Bundle) -> tuple[str, ...]:
        """Report the share of zeros, and the engines that benefit."""
        return describe_zeros(pruned, self.pattern)

    def _input_moments(
        self, layers: Mapping[str, Any], modules: Mapping[str, nn.Module], source: Bundle, context: Context
    ) -> dict[str, Tensor]:
        """Return name of a layer -> mean of x xT over its inputs on recorded observations."""
        program = BatchedProgram(source.manifest.program, modules)
        noise = draw_noise(program.noise, 1, np.random.default_rng(0))
        sums: dict[str, Any] = {}
        counts: dict[str, int] = {}
        names = {id(layer.weight): name for name, layer in layers.items()}

        def observe(weight: Tensor, rows: Tensor) -> None:
            if name := names.get(id(weight)):
                sums[name] = sums.get(name, 0) + rows.double().T @ rows.double()
                counts[name] = counts.get(name, 0) + len(rows)

        recorded = passages(source, program, noise, self.samples, 1)
        with require("torch", "build").no_grad(), observe_products(observe):
            for number, passage in enumerate(recorded):
                context.progress("collecting the inputs of layers", number / len(recorded))
                passage.run(program, noise)
        return {name: total / counts[name] for name, total in sums.items()}


def check_pattern(pattern: Pattern, ratio: float) -> None:
    """Refuse a ratio that is not that of the pattern."""
    if pattern != "unstructured" and ratio != 0.5:
        raise RecipeError(f"The pattern {pattern} keeps half of the weights.", "leave --ratio out")


def smallest_mask(score: Tensor, pattern: Pattern, share: float, *, rows: bool) -> Tensor:
    """Return the mask of the elements with the smallest scores; of equal ones the first.

    Args:
        score: (outputs, inputs).
        pattern: Pattern that limits the competition to neighbours.
        share: Share of the elements (with a pattern: of the neighbours, rounded).
        rows: Without a pattern: whether they compete within their row instead of in the whole layer.
    """
    torch = require("torch", "build")
    if pattern != "unstructured":
        _, size = PATTERNS[pattern]
        padded = torch.nn.functional.pad(score, (0, -score.shape[1] % size), value=torch.inf)
        ranks = padded.reshape(len(score), -1, size).argsort(dim=-1, stable=True).argsort(dim=-1)
        whole = (ranks < round(share * size)).reshape(len(score), -1)
        within: Tensor = whole[:, : score.shape[1]]
        return within
    flat = score if rows else score.reshape(1, -1)
    count = round(flat.shape[1] * share)
    ranks = flat.argsort(dim=1, stable=True).argsort(dim=1)
    return (ranks < count).reshape(score.shape)


def describe_zeros(pruned: Bundle, pattern: Pattern) -> tuple[str, str]:
    """Describe the share of zeros in a bundle, and the engines that benefit."""
    engines = usable_engines().values()
    gains = [engine.title for engine in engines if pattern in engine.sparse]
    others = " and ".join(engine.title for engine in engines)
    return (
        f"{zero_share(pruned):.1%} of the weights are zero; no tensor is smaller",
        f"faster in {', '.join(gains)}" if gains else f"{others} multiply zeros like other numbers: nothing is "
        "faster (measure it: vlatool compare). 2:4 is for sparse tensor cores; for speed: vlatool prune structured",
    )  # fmt: skip


@dataclass(frozen=True)
class LayerSelection:
    """Linear and convolution layers by name; ``GRAPH.name`` in a policy of several graphs.

    Args:
        prunable: Layers whose weights may become zero.
        dense: Names of the other layers.
    """

    prunable: dict[str, Any]
    dense: tuple[str, ...]

    def describe(self) -> tuple[str, ...]:
        """Describe the layers that stay dense; empty without any."""
        some, more = ", ".join(self.dense[:MAX_NAMED]), len(self.dense) - MAX_NAMED
        return (
            f"left dense: {some}{f' and {more} more' if more > 0 else ''} (--include names what else may go)",
        ) * bool(self.dense)


def select_layers(
    modules: Mapping[str, nn.Module], source: Bundle, include: tuple[str, ...], exclude: tuple[str, ...]
) -> LayerSelection:
    """Select the layers to prune; embeddings, norms, heads and output layers stay, unless included.

    A layer that several graphs share belongs to the first one; likewise a weight that several layers share.
    """
    found: dict[int, tuple[tuple[str, str], Any]] = {}
    for graph, module in modules.items():
        for name, part in module.named_modules():
            if is_product_layer(part):
                found.setdefault(id(part.weight), ((graph, name), part))
    named = dict(found.values())
    full = {(graph, name): f"{graph}.{name}" if len(modules) > 1 else name for graph, name in named}
    selection = Selection.protecting(PROTECTED_WORDS, source.manifest.parts, include, exclude)
    selection.check([*full.values(), *(name for _, name in named)], "layer")
    outputs = output_layers(modules, source, named.values()) if not include else set()
    prunable = {
        full[identity]: part
        for identity, part in named.items()
        if id(part) not in outputs and selection.selects({identity[1], full[identity]})
    }
    if not prunable:
        raise RecipeError(f"{source.manifest.name} has no layer to prune.", "look at --include and --exclude")
    dense = [name for identity, name in full.items() if name not in prunable]
    return LayerSelection(prunable, tuple(dense))
