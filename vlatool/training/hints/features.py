"""Distance of features: what a block gives, as such."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor


class Features:
    """Mean squared error of layer-normalised features; the student's are projected where widths differ.

    ``MSE(LN(S W), LN(T))`` with S (..., d) and T (..., D) of the same tokens and a learned W (d, D). The error and W
    are those of TinyBERT (Jiao et al., arXiv 1909.10351, ``L_hidn``); that features are normalised without a scale and
    an offset of their own, so that no single large channel decides, is from feature distillation (Wei et al., arXiv
    2205.14141), which normalises the teacher's. Here both are: the mean over the elements of a token is 2 less twice
    their correlation, between 0 and 4, so that a weight means the same in every policy.
    """

    projects: ClassVar[bool] = True
    """Whether the student's features must have the teacher's width."""

    def why_not(self, shape: Sequence[int], channels_first: bool) -> str:
        """Return why features of that shape cannot be compared so, as the end of a sentence; empty where they can."""
        return "" if len(shape) > 1 else f"they give {list(shape)}, which has no features"

    def __call__(self, student: Tensor, teacher: Tensor) -> Tensor:
        """Return the mean over features (..., D) of the same shape."""
        functional = require("torch", "build").nn.functional
        width = teacher.shape[-1:]
        loss: Tensor = functional.mse_loss(functional.layer_norm(student, width), functional.layer_norm(teacher, width))
        return loss
