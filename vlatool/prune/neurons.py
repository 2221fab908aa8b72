"""Structured pruning by magnitude: remove whole neurons, which is faster on every engine without sparse kernels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, require
from vlatool.module.edits import Edit, refuse_traced
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._selection import Selection
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn

ELEMENTWISE = (
    "CELU", "Dropout", "ELU", "GELU", "Hardsigmoid", "Hardswish", "Hardtanh", "Identity", "LeakyReLU", "Mish", "ReLU",
    "ReLU6", "SELU", "SiLU", "Sigmoid", "Softplus", "Softsign", "Tanh",
)  # fmt: skip
"""Elementwise modules of torch: a neuron before them is a neuron after them."""


class Neurons(ModuleStage):
    """Remove the neurons of least magnitude from the hidden layers of MLPs.

    A hidden layer lies between two Linear layers of an ``nn.Sequential`` with only elementwise modules between them. A
    neuron's magnitude is the product of the L2 norms of its incoming and of its outgoing weights, which bounds its
    contribution to the output. Train the policy afterwards (``vlatool distill weights`` takes the result).
    """

    ratio: float = Field(0.25, gt=0, lt=1, description="share of the neurons of each hidden layer to remove")
    multiple: int = Field(8, ge=1, description="keep a multiple of this many neurons, for vector units")
    include: tuple[str, ...] = Field((), description="globs of module names (of the first Linear); all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of module names to leave as they are")

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the neurons to keep; raises RecipeError when none can be pruned, or a pattern matches nothing."""
        layers = [(graph, *layer) for graph, module in modules.items() for layer in hidden_layers(module)]
        if not layers:
            refuse_traced(source, "hidden layers of an nn.Sequential", "vlatool prune neurons")
        names = [first for _, first, *_ in layers]
        selection = Selection(self.include, self.exclude)
        selection.check(names, "hidden layer")
        edits: list[Edit] = []
        for graph, first, second, incoming, outgoing in layers:
            if selection.selects((first,)):
                context.progress(f"pruning {first}", None)
                keep = self._kept_neurons(incoming, outgoing)
                edits += [Edit(graph, first, "outputs", keep), Edit(graph, second, "inputs", keep)]
        if not edits:
            raise RecipeError(
                f"{source.manifest.name} has no hidden layer to prune: two Linear layers of an nn.Sequential, with "
                "elementwise modules between them.",
                "look at --include and --exclude; other structures cannot be pruned yet",
            )
        return ModuleChanges(tuple(edits))

    def _kept_neurons(self, incoming: Any, outgoing: Any) -> tuple[int, ...]:
        """Return the indices of the neurons to keep, in ascending order."""
        torch = require("torch", "build")
        size = incoming.out_features
        share = max(1, round(size * (1 - self.ratio)))
        count = min(size, max(self.multiple, self.multiple * round(share / self.multiple)))
        magnitude = incoming.weight.detach().double().norm(dim=1) * outgoing.weight.detach().double().norm(dim=0)
        strongest = torch.argsort(magnitude, descending=True, stable=True)[:count]
        return tuple(sorted(int(index) for index in strongest))


def hidden_layers(module: nn.Module) -> Iterator[tuple[str, str, Any, Any]]:
    """Yield (name, name of the next, Linear, next Linear) of each hidden layer, except layers with shared weights."""
    torch = require("torch", "build")
    children = [value for part in module.modules() for value in (*part._parameters.values(), *part._modules.values())]
    uses = Counter(map(id, children))
    for name, part in module.named_modules():
        if type(part) is not torch.nn.Sequential:
            continue
        first: tuple[str, Any] | None = None
        for key, child in part._modules.items():
            path = f"{name}.{key}" if name else key
            if type(child) is torch.nn.Linear:
                if first is not None and all(
                    uses[id(weight)] < 2 for layer in (first[1], child) for weight in (layer, layer.weight)
                ):
                    yield first[0], path, first[1], child
                first = path, child
            elif type(child).__name__ not in ELEMENTWISE or not type(child).__module__.startswith("torch.nn"):
                first = None
