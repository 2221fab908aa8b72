"""Which layers give the action, whatever they are called."""

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


def last_layers(modules: Mapping[str, nn.Module], source: Bundle, layers: Collection[Any]) -> set[int]:
    """Return ``id`` of the layers after which no other layer computes the action.

    They are found by going back from the action through what autograd recorded; none where a policy gives its action
    without gradients.

    Args:
        modules: Graph name -> module.
        source: For the program and an observation.
        layers: With a ``weight``, such as Linear and convolution layers.
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
    """Yield the owners of the weights that are reached first on the ways back from an action."""
    seen, open_ = set(), [action.grad_fn] if action.grad_fn is not None else []
    while open_:
        node = open_.pop()
        if node in seen:
            continue
        seen.add(node)
        before: list[Any] = [earlier for earlier, _ in node.next_functions if earlier is not None]
        found = [owners[id(weight)] for each in before if id(weight := _weight(each)) in owners]
        yield from found
        open_ += [] if found else before


def _weight(node: Any) -> Any:
    """Return the weight that a node passes on, as it is or transposed; None where it computes something."""
    while not hasattr(node, "variable"):
        before = [earlier for earlier, _ in node.next_functions if earlier is not None]
        if len(before) != 1:
            return None
        node = before[0]
    return node.variable
