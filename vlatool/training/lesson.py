"""What a student is trained to make small."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor, nn


@dataclass(frozen=True)
class Lesson:
    """What a student is trained to make small.

    Args:
        name: Of the loss.
        modules: The student's, which are trained in place.
        loss: Rows of a batch, name -> (B, ...), as ``label`` wrote them -> the mean of their losses: a batch may be
            computed in parts.
        expert: The same for rows as ``Expert`` wrote them; None where no expert is asked.
    """

    name: str
    modules: Mapping[str, nn.Module]
    loss: Callable[[Mapping[str, Any]], Tensor]
    expert: Callable[[Mapping[str, Any]], Tensor] | None = None
