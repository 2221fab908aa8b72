"""Weights that pruning set to zero: which policies have them, how many there are, and how they are kept."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.module.edits import read_tensors
from vlatool.module.stage import ModuleStage
from vlatool.stage.build import stage_class
from vlatool.stage.finish import history

if TYPE_CHECKING:
    from torch import Tensor, nn


def has_zeros(bundle: Bundle) -> bool:
    """Return whether a stage on the way to a bundle set single weights to zero, as its build record tells."""
    return any(_leaves_zeros(str(entry.get("stage", ""))) for entry in history(bundle))


def sparse_weights(modules: Iterable[nn.Module]) -> list[Tensor]:
    """Return the weights (outputs, ...) of modules of which some elements are exactly zero; shared ones once.

    One that is nothing but zeros was made so by its author: no method of pruning leaves nothing.
    """
    found = {id(weight): weight for module in modules for weight in module.parameters() if weight.dim() > 1}
    return [weight for weight in found.values() if 0 < int(weight.count_nonzero()) < weight.numel()]


def zero_share(bundle: Bundle) -> float:
    """Return the share of zeros in the weights (outputs, ...) that a bundle holds; 0 where it holds none."""
    zeros = total = 0
    for name in bundle.manifest.files:
        for tensor in read_tensors(bundle.file(name)).values() if name.endswith(".safetensors") else ():
            zeros += int((tensor == 0).sum()) if tensor.dim() > 1 else 0
            total += tensor.numel() if tensor.dim() > 1 else 0
    return zeros / max(1, total)


def _leaves_zeros(stage: str) -> bool:
    try:
        kind = stage_class(stage)
    except VlatoolError:  # of another package that is not installed here, or of another version of vlatool
        return False
    return issubclass(kind, ModuleStage) and kind.leaves_zeros
