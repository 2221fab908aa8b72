"""How much the action moves with something: gradients along random directions of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

from vlatool.errors import require
from vlatool.module.batched_program import no_gradient_error

SEED = 0
PROBES = 4
"""Random directions of each action."""
FIX = "let make() return the module that was trained; or take a rank that needs none: --rank error, --rank magnitude"
Key = TypeVar("Key")


def slopes_of(actions: Iterable[Any], values: Mapping[Key, Any]) -> Iterator[dict[Key, Any]]:
    """Yield the gradients of each action along some directions: key -> gradient, of what the action depends on.

    Args:
        actions: Raw actions, made one by one from what is asked for.
        values: Tensors that ask for gradients.

    Raises:
        SourceError: when the policy gives actions without gradients.
    """
    torch = require("torch", "build")
    random = torch.Generator().manual_seed(SEED)
    for action in actions:
        if not action.requires_grad:
            raise no_gradient_error(FIX)
        for probe in range(PROBES):
            direction = torch.randn(action.shape, generator=random)
            slopes = torch.autograd.grad(
                (direction * action).sum(), list(values.values()), retain_graph=probe < PROBES - 1, allow_unused=True
            )
            yield {key: slope for key, slope in zip(values, slopes, strict=True) if slope is not None}
