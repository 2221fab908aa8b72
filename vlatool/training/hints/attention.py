"""Distance of relations: which tokens are like which others, in what a block gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import Tensor

SHARPNESS = 8.0
"""What cosines are multiplied with: products of normalised vectors in a head of 64 elements, over its root, are so."""


class Attention:
    """Divergence of the student's relations between tokens from the teacher's.

    A relation is a row of ``softmax(LN(X) LN(X)^T / d * 8)``: how much each token is like every other, in features X
    (T, d). The loss is ``mean_t KL(teacher's row t || student's row t)``, as MiniLMv2 has it (Wang et al., arXiv
    2012.15828, where X are the queries, keys and values of an attention layer, in several heads). Relations are tokens
    by tokens, so widths may differ without a projection.

    What an attention layer computes inside is not looked at: modules do not give it, and fused ones never hold it. X is
    what the whole block gives, in one head; it is normalised, and scaled as a head of 64 elements would be, since the
    plain products of features grow with their size and their number. That these relations do for policies what those
    of MiniLMv2 do for language models was not measured.
    """

    projects: ClassVar[bool] = False
    """Whether the student's features must have the teacher's width."""

    def why_not(self, shape: Sequence[int], channels_first: bool) -> str:
        """Return why features of that shape cannot be compared so, as the end of a sentence; empty where they can."""
        if channels_first or len(shape) != 3 or shape[0] != 1:
            return f"they give {list(shape)} for one observation, where tokens are [1, tokens, width]"
        return "" if shape[1] > 1 else f"they give a single token, {list(shape)}, which is like no other"

    def __call__(self, student: Tensor, teacher: Tensor) -> Tensor:
        """Return the mean over tokens of features (B, T, d) and (B, T, D)."""
        torch = require("torch", "build")
        ours, theirs = (torch.log_softmax(_similarity(each), dim=-1) for each in (student, teacher))
        rows = torch.nn.functional.kl_div(ours, theirs, reduction="none", log_target=True).sum(dim=-1)
        loss: Tensor = rows.mean()
        return loss


def _similarity(features: Tensor) -> Tensor:
    """Return what the softmax is taken of: (B, T, T)."""
    normal = require("torch", "build").nn.functional.layer_norm(features, features.shape[-1:])
    similar: Tensor = normal @ normal.transpose(-2, -1) * (SHARPNESS / features.shape[-1])
    return similar
