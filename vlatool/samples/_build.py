"""Build a module and fill it with seeded weights, in an order that nothing else can disturb."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)
NORMS = (nn.LayerNorm, nn.RMSNorm, nn.BatchNorm2d)
INIT_STD = 0.02


class Constants(nn.Module):
    """Base of a module whose buffers are computed, not learned.

    Modules are built on the meta device, so buffers get their values here and not in ``__init__``.
    """

    def reset_constants(self) -> None:
        """Write the values of all buffers."""
        raise NotImplementedError


def build(
    architecture: Callable[[], Module], seed: int, dtype: str = "float32", device: str | None = None, prefix: str = ""
) -> Module:
    """Return the module in eval mode with the weights of ``seed``; neither reads nor moves the global random state.

    Args:
        dtype: Name of a floating torch dtype; weights are drawn in float32 and rounded to it.
        device: Where the module lives, the CPU when None. ``"meta"`` costs no memory and leaves the weights undefined.
        prefix: Full name of the module inside the policy, when it is a part: ``"language.layers.7"``.

    Example:
        >>> build(lambda: nn.Linear(2, 1), seed=0).weight.shape
        torch.Size([1, 2])
    """
    with torch.device("meta"):
        module = architecture()
    _allocate(module, getattr(torch, dtype), device or "cpu")
    if device != "meta":
        fill(module, seed, prefix)
    return module.eval()


def _allocate(module: nn.Module, dtype: torch.dtype, device: str) -> None:
    """Replace all tensors by undefined ones; ``Module.to_empty`` cannot, under ``FakeTensorMode``."""
    for part in module.modules():
        for name, parameter in list(part.named_parameters(recurse=False)):
            part.register_parameter(name, nn.Parameter(torch.empty_like(parameter, dtype=dtype, device=device)))
        for name, buffer in list(part.named_buffers(recurse=False)):
            kept = dtype if buffer.is_floating_point() else buffer.dtype
            setattr(part, name, torch.empty_like(buffer, dtype=kept, device=device))


def fill(module: nn.Module, seed: int, prefix: str = "") -> None:
    """Fill parameters with seeded gaussians and buffers with their constants, in place.

    Matrices have the standard deviation 1 / sqrt(fan in), scales 1 +- 0.02, biases 0 +- 0.02. Every parameter has its
    own random stream, which depends only on ``seed`` and its full name: a part of a large policy can be built alone.

    Args:
        module: Any module; parameters on the meta device stay as they are.
    """
    with torch.no_grad():
        for path, part in module.named_modules(prefix=prefix):
            if isinstance(part, Constants):
                part.reset_constants()
            elif isinstance(part, nn.BatchNorm2d):
                part.reset_running_stats()
            for name, parameter in part.named_parameters(prefix=path, recurse=False):
                scales = name.endswith(".gain") or (isinstance(part, NORMS) and name.endswith("weight"))
                _draw(parameter, seed, name, 1.0 if scales else 0.0)


def _draw(parameter: Tensor, seed: int, name: str, centre: float) -> None:
    if parameter.is_meta:  # the module is built for its shapes alone
        return
    digest = hashlib.sha256(f"{seed}:{name}".encode()).digest()
    stream = torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))
    deviation = INIT_STD if parameter.ndim == 1 else 1 / math.sqrt(parameter[0].numel())
    values = torch.randn(parameter.shape, generator=stream, dtype=torch.float32)
    parameter.copy_(values.mul_(deviation).add_(centre))
