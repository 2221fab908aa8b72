"""Weights of which every process holds a part alone (FSDP2): whole only while the block that they belong to computes.

``fully_shard`` of torch.distributed cuts each weight along its first axis. Before a block runs, its weights are
gathered from all processes, and freed after it; ``backward`` does the same, and adds its gradients up part by part.
What a training keeps beside the weights (AdamW's moments, the average, the best) is of the parts alone.

A unit is what is gathered at once: each block of a stack, then what else a graph's module has. A weight stays whole in
every process where that cannot be: scalars, weights that several units share, other types, and modules that are traced
again for each batch size. All processes must call the units equally often.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import RecipeError, SourceError, require
from vlatool.module.blocks import stacks_of
from vlatool.module.cut import RETRACE
from vlatool.training.group import Group, lost_told

if TYPE_CHECKING:
    from torch import Tensor, nn

Owners = dict[int, list[tuple[Any, str]]]
"""Identity of a weight -> the modules that hold it, and its name in each."""
LEAVE = "leave --shard out: every process then holds all weights"


class Shards:
    """What a process holds of each weight: all of it here.

    Args:
        parameters: Name -> weight, as the modules have it.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter]) -> None:
        self.held: dict[str, Tensor] = dict(parameters)
        """Name -> what this process updates."""

    @property
    def several(self) -> bool:
        """Whether processes hold parts."""
        return False

    def summed(self, loss: float, group: Group) -> float:
        """Add gradients up after ``backward``, so that each held tensor has its own; return the sum of the losses."""
        return group.summed(loss, list(self.held.values()))

    def norm(self, group: Group) -> Tensor:
        """Return the norm of the gradient over all weights."""
        torch = require("torch", "build")
        gradients = [value.grad for value in self.held.values() if value.grad is not None]
        norm: Tensor = torch.nn.utils.get_total_norm(gradients)
        return norm

    def part(self, name: str, whole: Tensor) -> Tensor:
        """Return what this process holds of a tensor that is shaped as a weight."""
        return whole

    def whole(self, name: str, part: Tensor) -> Tensor:
        """Return a tensor of whose parts each process holds one; all must ask."""
        return part

    def size(self, name: str, part: Tensor) -> list[int]:
        """Return the shape of that tensor."""
        return list(part.shape)

    def gather(self, *, keep: bool) -> None:
        """Let modules hold whole weights; all processes must come.

        Args:
            keep: Whether they do in this process; else it gives its parts alone.
        """

    @contextlib.contextmanager
    def in_modules(self, *, keep: bool) -> Iterator[None]:
        """Do so within the block."""
        yield

    @contextlib.contextmanager
    def looking(self) -> Iterator[None]:
        """Let programs find out whether their modules take batches, with the same rows in every process."""
        yield


class Parts(Shards):
    """What a process holds of each weight: its part.

    Args:
        modules: Graph name -> module, which is changed in place.
        group: The processes.

    Raises:
        RecipeError: when no weight can be cut.
    """

    def __init__(self, modules: Mapping[str, nn.Module], group: Group) -> None:
        torch = require("torch", "build")
        self._tensor = require("torch.distributed.tensor", "build").DTensor
        trained_in(modules)
        with lost_told():
            self._root = _sharded(modules, group)
        weights = trained_in(modules)
        self._cut: dict[str, Any] = {name: value for name, value in weights.items() if isinstance(value, self._tensor)}
        if not self._cut:
            raise RecipeError(
                "--shard would share no weight out: the modules are traced again for each batch size, or have none of "
                "their own.", LEAVE
            )  # fmt: skip
        self._owners = _owners(modules)
        with torch.no_grad():  # the same memory: a step that changes a part changes what is gathered next
            parts = {name: torch.nn.Parameter(value.to_local().detach()) for name, value in self._cut.items()}
        super().__init__({**weights, **parts})

    @property
    def several(self) -> bool:
        """Whether processes hold parts."""
        return True

    def summed(self, loss: float, group: Group) -> float:
        """Add up the gradients of weights that are whole, and take those of parts, which are added up already."""
        with require("torch", "build").no_grad():
            for name, value in self._cut.items():
                gradient: Any = value.grad
                if gradient is not None:
                    self.held[name].grad, value.grad = gradient.to_local(), None
        return group.summed(loss, [value for name, value in self.held.items() if name not in self._cut])

    def norm(self, group: Group) -> Tensor:
        """Return the norm of the gradient over all parts of all weights."""
        torch = require("torch", "build")
        squares = {True: 0.0, False: 0.0}
        for name, value in self.held.items():
            if value.grad is not None:
                squares[name in self._cut] += float(torch.linalg.vector_norm(value.grad, dtype=torch.float64)) ** 2
        norm: Tensor = torch.tensor((squares[False] + group.total(squares[True])) ** 0.5)
        return norm

    def part(self, name: str, whole: Tensor) -> Tensor:
        """Return this process's rows."""
        if name not in self._cut or not whole.dim():
            return whole
        mesh, value = self._cut[name].device_mesh, self._cut[name]
        rows = -(-len(value) // mesh.size())
        part: Tensor = whole[mesh.get_local_rank() * rows :][:rows]
        return part

    def whole(self, name: str, part: Tensor) -> Tensor:
        """Return all rows."""
        if name not in self._cut or not part.dim():
            return part
        value: Any = self._cut[name]
        with lost_told(), require("torch", "build").no_grad():
            rows = self._tensor.from_local(
                part.detach(), value.device_mesh, value.placements, run_check=False, shape=value.shape,
                stride=value.stride(),
            )  # fmt: skip
            whole: Tensor = rows.full_tensor()
        return whole

    def size(self, name: str, part: Tensor) -> list[int]:
        """Return the shape with all rows."""
        return list(self._cut[name].shape if name in self._cut and part.dim() else part.shape)

    def gather(self, *, keep: bool) -> None:
        """Gather one weight after the other; what is gathered is no part of the training."""
        parameter = require("torch", "build").nn.Parameter
        for name, value in self._cut.items():
            whole = self.whole(name, self.held[name])
            if keep:
                self._put(value, parameter(whole, requires_grad=False))

    @contextlib.contextmanager
    def in_modules(self, *, keep: bool) -> Iterator[None]:
        """Do so within the block."""
        self.gather(keep=keep)
        try:
            yield
        finally:
            for value in self._cut.values() if keep else ():
                self._put(value, value)

    def _put(self, value: nn.Parameter, instead: nn.Parameter) -> None:
        for module, name in self._owners[id(value)]:
            setattr(module, name, instead)

    @contextlib.contextmanager
    def looking(self) -> Iterator[None]:
        """Begin anew afterwards: a module that takes no batches may fail while its weights are whole.

        Raises:
            SourceError: when a module uses weights of a part of it that does not run, with what to do.
        """
        try:
            with require("torch", "build").no_grad():
                yield
        except SourceError as error:
            if "DTensor" not in error.message:
                raise
            raise SourceError(error.message, f"a weight is used while its block does not run; {LEAVE}") from error
        self._root.reset_iter_state()


def _sharded(modules: Mapping[str, nn.Module], group: Group) -> Any:
    """Cut the weights of modules; return what holds all units."""
    torch = require("torch", "build")
    fsdp = require("torch.distributed.fsdp", "build")
    kind = torch.get_default_device().type
    mesh = require("torch.distributed.device_mesh", "build").init_device_mesh(kind, (group.size,))
    cut = {graph: module for graph, module in modules.items() if _runs_as_it_is(module)}

    class Root(torch.nn.ModuleList):  # type: ignore[misc, name-defined]
        """All units; runs first, and computes nothing, so that none of them takes itself for the first."""

        def forward(self) -> None:
            """Give nothing."""

    for unit, others in _units(cut, modules):
        unit.register_forward_hook(_apart)
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


def _apart(_module: Any, _arguments: Any, gives: Any) -> Any:
    """Copy what a unit gives as a view: an operation in place on it would lose what prepares ``backward``."""
    if isinstance(gives, require("torch", "build").Tensor):
        return gives.clone() if gives._is_view() else gives
    return type(gives)(_apart(None, None, each) for each in gives) if type(gives) in (tuple, list) else gives


def _runs_as_it_is(module: Any) -> bool:
    """Say whether a module is called itself: no container, and none that is traced again for each batch size."""
    nn = require("torch", "build").nn
    return getattr(module, RETRACE, None) is None and not isinstance(module, nn.ModuleDict | nn.ModuleList)


def _units(cut: Mapping[str, nn.Module], modules: Mapping[str, nn.Module]) -> list[tuple[Any, set[Any]]]:
    """Return what is gathered at once, from the inside outwards, each with its weights that stay whole there."""
    owners, seen, taken = _owners(modules), set[int](), set[int]()
    blocks = [block for _, stack in reversed(stacks_of(cut, mixed=True)) for block in stack]
    units = []
    for unit in dict.fromkeys([*filter(_runs_as_it_is, blocks), *cut.values()]):
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


def _owners(modules: Mapping[str, nn.Module]) -> Owners:
    """Return who holds each weight."""
    found: Owners = {}
    parts = {id(part): part for module in modules.values() for part in module.modules()}
    for part in parts.values():
        for name, value in part._parameters.items():
            if value is not None:
                found.setdefault(id(value), []).append((part, name))
    return found


def shards_of(modules: Mapping[str, nn.Module], group: Group, *, cut: bool) -> Shards:
    """Return what this process holds of the weights of modules, all of which ask for gradients from now on."""
    if cut:
        return Parts(modules, group)
    return Shards(trained_in(modules))


def trained_in(modules: Mapping[str, nn.Module]) -> dict[str, nn.Parameter]:
    """Return name -> weight of all that is trained; one that several graphs share comes once."""
    found: dict[int, tuple[str, nn.Parameter]] = {}
    for graph, module in modules.items():
        for name, value in module.named_parameters():
            if value.dtype.is_floating_point:
                found.setdefault(id(value), (f"{graph}.{name}", value))
    for _, value in found.values():
        value.requires_grad_()
    return dict(found.values())
