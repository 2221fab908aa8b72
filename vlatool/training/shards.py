"""Weights of which every process holds a part alone (FSDP2): whole only while the block that they belong to computes.

``fully_shard`` of torch.distributed cuts each weight along its first axis. Before a block runs, its weights are
gathered from all processes, and freed after it; ``backward`` does the same, and adds its gradients up part by part.
What a training keeps beside the weights (AdamW's moments, the average, the best) is of the parts alone.

What is gathered at once, and what stays whole, says ``units``. All processes must call the units equally often.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from vlatool.errors import RecipeError, SourceError, require
from vlatool.training.group import LOST_PROCESS, RUN_AGAIN, Group, map_lost_process
from vlatool.training.units import cut_units, owners_of

if TYPE_CHECKING:
    from torch import Tensor, nn

COMMUNICATION_ERRORS = ("/gloo/", "NCCL", "ncclUnhandled", "Connection closed by peer", "Connection reset by peer")
"""Parts of messages of torch.distributed."""
LEAVE = "leave --shard out: every process then holds all weights"


class Shards:
    """What a process holds of each weight (name -> weight, as the modules have it): all of it here."""

    def __init__(self, parameters: Mapping[str, nn.Parameter]) -> None:
        self.held: dict[str, Tensor] = dict(parameters)
        """Name -> what this process updates."""

    @property
    def several(self) -> bool:
        """Whether processes hold parts."""
        return False

    def sum_gradients(self, loss: float, group: Group) -> float:
        """Add gradients up after ``backward``, so that each held tensor has its own; return the sum of the losses."""
        return group.sum_gradients(loss, list(self.held.values()))

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
            keep: whether they do in this process; else it gives its parts alone.
        """

    @contextlib.contextmanager
    def in_modules(self, *, keep: bool) -> Iterator[None]:
        """Do so within the block."""
        yield

    @contextlib.contextmanager
    def probing_batches(self) -> Iterator[None]:
        """Let programs find out whether their modules take batches, with the same rows in every process."""
        yield

    @contextlib.contextmanager
    def computing(self) -> Iterator[None]:
        """Say of a module that fails since another process is gone, that one is gone."""
        yield


class Parts(Shards):
    """What a process holds of each weight: its part.

    Args:
        modules: graph name -> module, which is changed in place.

    Raises:
        RecipeError: when no weight can be cut.
    """

    def __init__(self, modules: Mapping[str, nn.Module], group: Group) -> None:
        torch = require("torch", "build")
        self._tensor = require("torch.distributed.tensor", "build").DTensor
        trainable_weights(modules)
        with map_lost_process():
            self._root = cut_units(modules, group)
        _release_memory()
        weights = trainable_weights(modules)
        self._cut: dict[str, Any] = {name: value for name, value in weights.items() if isinstance(value, self._tensor)}
        if not self._cut:
            raise RecipeError(
                "--shard would share no weight out: the modules are traced again for each batch size, or have none of "
                "their own.", LEAVE
            )  # fmt: skip
        self._owners = owners_of(modules)
        with torch.no_grad():  # the same memory: a step that changes a part changes what is gathered next
            parts = {name: torch.nn.Parameter(value.to_local().detach()) for name, value in self._cut.items()}
        super().__init__({**weights, **parts})

    @property
    def several(self) -> bool:
        """Whether processes hold parts."""
        return True

    def sum_gradients(self, loss: float, group: Group) -> float:
        """Add up the gradients of weights that are whole, and take those of parts, which are added up already."""
        with require("torch", "build").no_grad():
            for name, value in self._cut.items():
                gradient: Any = value.grad
                if gradient is not None:
                    self.held[name].grad, value.grad = gradient.to_local(), None
        return group.sum_gradients(loss, [value for name, value in self.held.items() if name not in self._cut])

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
        return whole[mesh.get_local_rank() * rows :][:rows]

    def whole(self, name: str, part: Tensor) -> Tensor:
        """Return all rows."""
        if name not in self._cut or not part.dim():
            return part
        value: Any = self._cut[name]
        with map_lost_process(), require("torch", "build").no_grad():
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
        """Gather one weight after the other; gathered weights are not part of the training."""
        parameter = require("torch", "build").nn.Parameter
        _release_memory()
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
    def computing(self) -> Iterator[None]:
        """Tell what fails between processes from what fails in a module: weights are gathered while it runs.

        Raises:
            SourceError: when another process is gone.
        """
        try:
            yield
        except (RuntimeError, SourceError) as error:
            if any(name in str(error) for name in COMMUNICATION_ERRORS):  # the modules of a user run in the midst of it
                raise SourceError(LOST_PROCESS, RUN_AGAIN) from error
            raise

    @contextlib.contextmanager
    def probing_batches(self) -> Iterator[None]:
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


def _release_memory() -> None:
    """Let the system have the memory of what was freed, such as what was loaded whole; glibc would keep it."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def shards_of(modules: Mapping[str, nn.Module], group: Group, *, cut: bool) -> Shards:
    """Return what this process holds of the weights of modules, all of which ask for gradients from now on."""
    if cut:
        return Parts(modules, group)
    return Shards(trainable_weights(modules))


def trainable_weights(modules: Mapping[str, nn.Module]) -> dict[str, nn.Parameter]:
    """Return name -> weight of all that is trained; one that several graphs share comes once."""
    found: dict[int, tuple[str, nn.Parameter]] = {}
    for graph, module in modules.items():
        for name, value in module.named_parameters():
            if value.dtype.is_floating_point:
                found.setdefault(id(value), (f"{graph}.{name}", value))
    for _, value in found.values():
        value.requires_grad_()
    return dict(found.values())
