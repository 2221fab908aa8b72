"""Stacks of blocks: consecutive parts of a module whose outputs have the form of their inputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import require

if TYPE_CHECKING:
    from torch import nn


def stacks(module: nn.Module, *, mixed: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield (name, stack) of every list or sequence of at least two modules of one class with equal weights' shapes.

    Args:
        mixed: whether to yield also lists of modules of several kinds, such as layers that alternate.
    """
    nn = require("torch", "build").nn
    for name, part in module.named_modules():
        if not isinstance(part, nn.ModuleList | nn.Sequential) or len(part) < 2:
            continue
        kinds = {type(block) for block in part}
        shapes = {
            tuple((key, tuple(value.shape)) for key, value in block.state_dict(keep_vars=True).items())
            for block in part
        }
        shared = len({id(block) for block in part}) < len(part)
        alike = len(kinds) == 1 and len(shapes) == 1
        if (alike or (mixed and isinstance(part, nn.ModuleList))) and shapes != {()} and not shared:
            yield name, part


def block_names(module: nn.Module, stack: str) -> list[str]:
    """Return the names of the blocks of a stack, in order; none where the module has no such part.

    Args:
        module: module as a factory makes it, or traced: then its stacks are no longer lists, but keep their names.
    """
    part = dict(module.named_modules()).get(stack)
    names = [] if part is None else [name for name, _ in part.named_children() if "@" not in name]
    return [f"{stack}.{name}" if stack else name for name in names]


def first(gives: Any) -> Any:
    """Return what a block hands on to the next one: the first of what it gives."""
    return gives[0] if isinstance(gives, tuple | list) else gives


def stacks_of(modules: Mapping[str, nn.Module], *, mixed: bool = False) -> list[tuple[dict[str, str], Any]]:
    """Return (graph name -> name, stack) of every stack of a policy; one that graphs share comes once."""
    found: dict[int, tuple[dict[str, str], Any]] = {}
    for graph, module in modules.items():
        for name, stack in stacks(module, mixed=mixed):
            found.setdefault(id(stack), ({}, stack))[0][graph] = name
    return list(found.values())
