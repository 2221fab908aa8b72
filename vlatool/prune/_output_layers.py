"""The layers that compute the action, whatever their names."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import require
from vlatool.module.batched_program import BatchedProgram, draw_noise
from vlatool.module.feeds import recorded_inputs

if TYPE_CHECKING:
    from torch import Tensor, nn


def output_layers(modules: Mapping[str, nn.Module], source: Bundle, layers: Collection[Any]) -> set[int]:
    """Return ``id`` of the layers after which no other layer computes the action.

    They are found in autograd's graph, backwards from the action; the set is empty where the action has no gradients.

    Args:
        layers: Layers with a ``weight``, such as Linear and convolution layers.
    """
    torch = require("torch", "build")
    program = BatchedProgram(source.manifest.program, modules)
    noise = draw_noise(program.noise, 1, np.random.default_rng(0))
    weights = {layer.weight: id(layer) for layer in layers if layer.weight.is_floating_point()}
    frozen = [weight for weight in weights if not weight.requires_grad]
    try:
        for weight in frozen:
            weight.requires_grad_()
        with torch.enable_grad():
            action = program.run(recorded_inputs(source, 1)[0], noise)[source.manifest.spec.action.name]
        return set(_owners(action, {id(weight): owner for weight, owner in weights.items()}))
    finally:
        for weight in frozen:
            weight.requires_grad_(False)


def _owners(action: Tensor, owners: Mapping[int, int]) -> Iterator[int]:
    """Yield the owners of the weights that are reached first on the paths back from an action."""
    visited, pending = set(), [action.grad_fn] if action.grad_fn is not None else []
    while pending:
        node = pending.pop()
        if node in visited:
            continue
        visited.add(node)
        earlier_nodes: list[Any] = [earlier for earlier, _ in node.next_functions if earlier is not None]
        found = [owners[id(weight)] for each in earlier_nodes if id(weight := _weight(each)) in owners]
        yield from found
        pending += [] if found else earlier_nodes


def _weight(node: Any) -> Any:
    """Return the weight that a node passes on, unchanged or transposed; None where it computes something."""
    while not hasattr(node, "variable"):
        before = [earlier for earlier, _ in node.next_functions if earlier is not None]
        if len(before) != 1:
            return None
        node = before[0]
    return node.variable
