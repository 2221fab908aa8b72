"""Which weights are cut together and gathered at once (FSDP2): blocks, and what else the module of a graph has.

A weight stays whole in every process where it cannot be cut: scalars, weights that several units share, other types
than most of the unit, and modules that are traced again for each batch size.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import require
from vlatool.module.blocks import stacks_of
from vlatool.module.unit_removal import RETRACE
from vlatool.training.group import Group

if TYPE_CHECKING:
    from torch import nn

Owners = dict[int, list[tuple[Any, str]]]
"""Identity of a weight -> the modules that hold it, and its name in each."""


def cut_units(modules: Mapping[str, nn.Module], group: Group) -> Any:
    """Cut the weights of modules; return what holds all units."""
    torch = require("torch", "build")
    fsdp = require("torch.distributed.fsdp", "build")
    kind = torch.get_default_device().type
    mesh = require("torch.distributed.device_mesh", "build").init_device_mesh(kind, (group.size,))
    cut = {graph: module for graph, module in modules.items() if _is_called_directly(module)}

    class Root(torch.nn.ModuleList):  # type: ignore[misc, name-defined]
        """All units; runs first, and computes nothing, so that none of them takes itself for the first."""

        def forward(self) -> None:
            """Give nothing."""

    for unit, others in _units(cut, modules):
        unit.register_forward_hook(_copy_views)
        fsdp.fully_shard(unit, mesh=mesh, reshard_after_forward=True, ignored_params=others)
        unit.set_gradient_divide_factor(1.0)  # sums, as without shards
        unit.set_force_sum_reduction_for_comms(True)
    root = Root(cut.values())
    tensor = require("torch.distributed.tensor", "build").DTensor
    fsdp.fully_shard(
        root, mesh=mesh, ignored_params={each for each in root.parameters() if not isinstance(each, tensor)}
    )
    root()
    return root


def _copy_views(_module: Any, _arguments: Any, gives: Any) -> Any:
    """Copy what a unit gives as a view: an operation in place on it would lose what prepares ``backward``."""
    if isinstance(gives, require("torch", "build").Tensor):
        return gives.clone() if gives._is_view() else gives
    return type(gives)(_copy_views(None, None, each) for each in gives) if type(gives) in (tuple, list) else gives


def _is_called_directly(module: Any) -> bool:
    """Say whether a module is called itself: no container, and none that is traced again for each batch size."""
    nn = require("torch", "build").nn
    return getattr(module, RETRACE, None) is None and not isinstance(module, nn.ModuleDict | nn.ModuleList)


def _units(cut: Mapping[str, nn.Module], modules: Mapping[str, nn.Module]) -> list[tuple[Any, set[Any]]]:
    """Return what is gathered at once, from the inside outwards, each with its weights that stay whole there."""
    owners, seen, taken = owners_of(modules), set[int](), set[int]()
    blocks = [block for _, stack in reversed(stacks_of(cut, mixed=True)) for block in stack]
    units = []
    for unit in dict.fromkeys([*filter(_is_called_directly, blocks), *cut.values()]):
        fits = _fitting(unit, owners, seen, _outside(unit, modules))
        seen |= {id(value) for value in unit.parameters()}
        taken |= fits
        if fits:
            units.append((unit, {value for value in unit.parameters() if id(value) not in taken}))
    return units


def _fitting(unit: Any, owners: Owners, seen: set[int], outside: set[int]) -> set[int]:
    """Return the weights of a unit that are cut with it: of one type, no scalars, and nobody else's."""
    fits = [value for value in unit.parameters()
            if id(value) not in seen and value.dim() and value.dtype.is_floating_point and value.is_contiguous()
            and all(id(module) not in outside for module, _ in owners[id(value)])]  # fmt: skip
    sizes = Counter[Any]()
    for value in fits:
        sizes[value.dtype] += value.numel()
    return {id(value) for value in fits if value.dtype == max(sizes, key=sizes.__getitem__)}


def _outside(unit: Any, modules: Mapping[str, nn.Module]) -> set[int]:
    """Return what runs although a unit does not: all modules that another path leads to."""
    found, waiting = set[int](), list[Any](modules.values())
    while waiting:
        module = waiting.pop()
        if module is not unit and id(module) not in found:
            found.add(id(module))
            waiting += module.children()
    return found


def owners_of(modules: Mapping[str, nn.Module]) -> Owners:
    """Return who holds each weight."""
    found: Owners = {}
    parts = {id(part): part for module in modules.values() for part in module.modules()}
    for part in parts.values():
        for name, value in part._parameters.items():
            if value is not None:
                found.setdefault(id(value), []).append((part, name))
    return found
