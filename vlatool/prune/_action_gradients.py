"""Gradients of the action along random directions: how sensitive it is to some values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

from vlatool.errors import require
from vlatool.module.batched_program import no_gradient_error

SEED = 0
PROBES = 4
"""Number of random directions for each action."""
NO_GRADIENT_FIX = (
    "let make() return the trained module; or use a rank without gradients: --rank error, --rank magnitude"
)
Key = TypeVar("Key")


def action_gradients(actions: Iterable[Any], values: Mapping[Key, Any]) -> Iterator[dict[Key, Any]]:
    """Yield the gradients of each action along random directions: key -> gradient, where the action depends on it.

    Args:
        actions: Raw actions, computed one by one from the values.
        values: Tensors that require gradients.
    """
    torch = require("torch", "build")
    random = torch.Generator().manual_seed(SEED)
    for action in actions:
        if not action.requires_grad:
            raise no_gradient_error(NO_GRADIENT_FIX)
        for probe in range(PROBES):
            direction = torch.randn(action.shape, generator=random)
            gradients = torch.autograd.grad(
                (direction * action).sum(), list(values.values()), retain_graph=probe < PROBES - 1, allow_unused=True
            )
            yield {key: gradient for key, gradient in zip(values, gradients, strict=True) if gradient is not None}
