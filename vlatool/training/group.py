"""Processes that train one student together: each takes its share of every batch, and gradients are added up.

Modules are not wrapped (``DistributedDataParallel`` hooks into ``forward``, and a program calls modules many times, row
by row, or traces them again): every process has the same weights, adds its gradients to those of the others after
``backward``, and takes the same step. Sums are the same bits in all processes, so the weights stay equal. Where each
process holds a part of the weights alone, see ``shards``.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vlatool.errors import SourceError, require

if TYPE_CHECKING:
    from torch import Tensor

LOST_PROCESS = "Another process of the training is gone."
RUN_AGAIN = "run the same command again: it goes on from the last checkpoint"
INTERFACE = "GLOO_SOCKET_IFNAME"
BACKENDS = {"cpu": "gloo", "cuda": "cpu:gloo,cuda:nccl"}
"""Device -> what adds up: counts and losses on the processor in any case."""


@dataclass(frozen=True)
class Group:
    """Which of the processes this one is; ``rank`` 0, the first one, plays, labels and writes."""

    rank: int = 0
    size: int = 1

    def sum_gradients(self, loss: float, weights: Sequence[Tensor]) -> float:
        """Replace gradients by their sums over all processes; return the sum of the losses.

        A weight that got no gradient anywhere has none afterwards.

        Raises:
            SourceError: when another process is gone.
        """
        if self.size == 1:
            return loss
        with map_lost_process():
            return _sum_gradients(loss, weights)

    def total(self, number: float) -> float:
        """Return the sum of a number over all processes, the same bits in each; raises SourceError when one is gone."""
        return self.sum_gradients(number, ())


@contextlib.contextmanager
def map_lost_process() -> Iterator[None]:
    """Say of what fails between processes that one of them is gone."""
    try:
        yield
    except RuntimeError as error:
        raise SourceError(LOST_PROCESS, RUN_AGAIN) from error


def _sum_gradients(loss: float, weights: Sequence[Tensor]) -> float:
    torch = require("torch", "build")
    has = [float(value.grad is not None) for value in weights]
    numbers = torch.tensor([loss, *has], dtype=torch.float64, device="cpu")
    torch.distributed.all_reduce(numbers)
    used = [value for value, count in zip(weights, numbers[1:].tolist(), strict=True) if count]
    for value in used:
        if value.grad is None:
            value.grad = torch.zeros_like(value)
    for dtype in dict.fromkeys(value.dtype for value in used):
        _add_up([value.grad for value in used if value.dtype == dtype and value.grad is not None])
    return float(numbers[0])


def _add_up(gradients: Sequence[Tensor]) -> None:
    """Replace gradients of one dtype by their sums, in one message."""
    torch = require("torch", "build")
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    torch.distributed.all_reduce(flat)
    for gradient, total in zip(gradients, flat.split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(total.view_as(gradient))


@contextlib.contextmanager
def join_group(store: Callable[[], Any], group: Group, device: str = "cpu", *, here: bool = True) -> Iterator[None]:
    """Be one of the processes of a group within the block; all of them must come.

    Args:
        store: opens a store of ``torch.distributed`` through which they find each other; a new one for each group.
        device: ``cpu`` or ``cuda``, of what is added up.
        here: whether all of them are on this machine, so that no other one needs to reach them.

    Raises:
        SourceError: when they do not find each other.
    """
    if group.size == 1:
        yield
        return
    distributed = require("torch.distributed", "build")
    with _on_this_machine() if here else contextlib.nullcontext(), map_lost_process():
        distributed.init_process_group(BACKENDS[device], store=store(), rank=group.rank, world_size=group.size)
    try:
        yield
    finally:
        distributed.destroy_process_group()


@contextlib.contextmanager
def _on_this_machine() -> Iterator[None]:
    """Let gloo listen where no other machine reaches it."""
    names = [name for _, name in socket.if_nameindex() if name.startswith("lo")]
    before = os.environ.get(INTERFACE)
    os.environ.update({INTERFACE: names[0]} if names else {})
    try:
        yield
    finally:
        os.environ.pop(INTERFACE, None)
        os.environ.update({INTERFACE: before} if before is not None else {})
