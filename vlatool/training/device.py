"""The device of a training: the processor, or a GPU where there is one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from vlatool.errors import RecipeError, require
from vlatool.files.printable import message_of, one_line
from vlatool.machine import host

if TYPE_CHECKING:
    from torch import Tensor, nn

DeviceChoice = Literal["auto", "cpu", "cuda"]
BFLOAT16 = ("amx_bf16", "avx512_bf16", "bf16")
"""Features of processors that multiply bfloat16 natively: twice as fast as float32 here."""
WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
"""Without it, products of cuBLAS differ from run to run (https://docs.pytorch.org/docs/stable/notes/randomness.html)."""


@dataclass(frozen=True)
class Device:
    """A kind of device, and how matrix products are computed on it.

    Args:
        name: ``cpu`` or ``cuda``.
        bfloat16: whether products are computed in bfloat16 (autocast); weights and their updates are float32.
    """

    name: str = "cpu"
    bfloat16: bool = False

    @property
    def precision(self) -> str:
        """Return what products are computed in."""
        return "bfloat16" if self.bfloat16 else "float32"

    @contextlib.contextmanager
    def computing(self) -> Iterator[None]:
        """Make the tensors of the block on the device; raises RecipeError when the memory of a GPU is full."""
        if self.name == "cpu":
            yield
            return
        torch = require("torch", "build")
        before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
        os.environ.setdefault(WORKSPACE, ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        try:
            with torch.device(self.name):
                yield
        except torch.OutOfMemoryError as error:
            raise RecipeError(
                f"The memory of the GPU is full: {one_line(message_of(error))}",
                "take a smaller --batch, compute it in parts (--accumulate 4), or take --device cpu",
            ) from error
        finally:
            torch.use_deterministic_algorithms(before[0], warn_only=before[1])

    def casting(self, *, enabled: bool = True) -> contextlib.AbstractContextManager[Any]:
        """Return a context in which products are computed as asked; in float32 where it is not enabled."""
        torch = require("torch", "build")
        context: contextlib.AbstractContextManager[Any] = torch.autocast(
            self.name, torch.bfloat16, enabled=enabled and self.bfloat16
        )
        return context

    def choose(self, number: int) -> None:
        """Let a GPU be the one that this process computes on, where it computes on one."""
        if self.name == "cuda":
            require("torch", "build").cuda.set_device(number)

    @contextlib.contextmanager
    def holding(self, *programs: Mapping[str, nn.Module]) -> Iterator[None]:
        """Keep modules on the device within the block, and bring them back after it."""
        with contextlib.ExitStack() as back:
            for module in (module for modules in programs for module in modules.values()):
                if self.name != "cpu":
                    back.callback(module.to, "cpu")
                    module.to(self.name)
            yield


CPU = Device()
"""A processor, in float32."""


def device_of(asked: DeviceChoice, precision: str, processes: int = 1, here: int | None = None) -> Device:
    """Return what to compute on, and how.

    Args:
        asked: ``auto``: a GPU where torch has one; several processes share the processors unless ``cuda`` is asked for.
        precision: ``auto``: bfloat16 where the device multiplies it natively.
        here: how many of them are on this machine, each with a GPU of its own; all when None.

    Raises:
        RecipeError: when a GPU is asked for where there is none, or by more processes than there are.
    """
    cuda = require("torch", "build").cuda
    has = cuda.is_available()
    if asked == "cuda" and not has:
        raise RecipeError("--device cuda was asked for, and this torch finds no GPU.", "take --device cpu or auto")
    wanted = processes if here is None else here
    if asked == "cuda" and wanted > cuda.device_count():
        raise RecipeError(
            f"--device cuda takes a GPU for each process of a machine; asked for {wanted}, torch finds "
            f"{cuda.device_count()}.",
            "start fewer processes, or share the processors: --device cpu",
        )
    name = "cuda" if has and asked != "cpu" and (processes == 1 or asked == "cuda") else "cpu"
    native = cuda.is_bf16_supported(including_emulation=False) if name == "cuda" else has_bfloat16()
    return Device(name, precision == "bfloat16" or (precision == "auto" and bool(native)))


def has_bfloat16() -> bool:
    """Say whether this processor multiplies bfloat16 natively."""
    return bool({*BFLOAT16} & {*(host.isa() or ())})


def device_in_use() -> Device:
    """Return the device on which tensors are made now."""
    return Device(require("torch", "build").get_default_device().type)


def on_device(value: Any) -> Tensor:
    """Return an array as a tensor where tensors are made now; on a processor it shares its memory."""
    torch = require("torch", "build")
    tensor: Tensor = torch.from_numpy(value).to(torch.get_default_device())
    return tensor
