"""Count the work of a policy that is not exported yet, by running its torch modules without the bytes of weights."""

from __future__ import annotations

import contextlib
import importlib
import math
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError, require
from vlatool.files.printable import message_of
from vlatool.graph.workload import GraphWorkload, Tally, Workload, part_of
from vlatool.graph.workload_file import from_values, to_values
from vlatool.module.fake_weights import meta_float32_modules, run_on_fake_tensors
from vlatool.user_code import children

PRELOAD = ("torch", "torch._dynamo", __name__)
"""What counting needs; imported once, by the server that forks the children."""
PRODUCTS = {"mm": 0, "bmm": 0, "addmm": 1, "baddbmm": 1}
"""Operator of torch -> the position of its first factor."""
ATTENTION = "_scaled_dot_product"


def counted_apart(bundle: Bundle, tell: Callable[[str, float | None], None]) -> Workload:
    """Count as ``torch_workload`` does, in a child process: the policy's code runs there.

    Raises:
        SourceError: when the factory or a module fails, or ends its process.
    """
    about = str(bundle.manifest.source.get("factory", "")).rpartition(":")[0]
    job = {"bundle": str(bundle.path.absolute())}
    values = children.call("vlatool.boards.torch_workload:count", job, tell, about, PRELOAD)
    counted = from_values(values)
    if counted is None:
        raise SourceError(
            f"{about} gave a count that is not one.", "let the policy's code write to its own files alone"
        )
    return counted


def count(job: Mapping[str, Any], _tell: Callable[[str, float | None], None]) -> dict[str, Any]:
    """Count in this process; see ``counted_apart``."""
    return to_values(torch_workload(Bundle.open(Path(job["bundle"]), verify=False)))


def torch_workload(bundle: Bundle) -> Workload:
    """Count one inference of a source bundle whose policy is a torch factory.

    Raises:
        SourceError: when the factory or a module fails.
        MissingExtra: when torch is not installed.
    """
    require("torch", "build")
    with warnings.catch_warnings():  # a factory that loads its weights loads them into nothing
        warnings.simplefilter("ignore")
        modules = meta_float32_modules(bundle)
    graphs: dict[str, GraphWorkload] = {}
    runs: Counter[str] = Counter()
    seen: dict[str, _Seen] = {}

    def visit(step: ProgramStep, module: Any, _feeds: list[Any], _real: dict[str, Any]) -> Any:
        runs[step.graph] += step.repeat
        if step.graph in seen:
            return None
        seen[step.graph] = _Seen(_stored(module), _where(module, bundle.manifest.parts))
        return _watching(seen[step.graph])

    try:
        run_on_fake_tensors(bundle, modules, visit)
    except SourceError:
        raise
    except Exception as error:  # the seam: a policy's forward raises what it likes
        reason = (message_of(error).strip() or type(error).__name__).splitlines()[0][:300]
        raise SourceError(
            f"The policy cannot be run without its weights: {type(error).__name__}: {reason}.",
            "export it first, and name the bundle: vlatool export SOURCE -o BUNDLE",
        ) from error
    for name, run in seen.items():
        tally = run.tally
        graphs[name] = GraphWorkload(
            {"float32": run.macs}, tally.layers, tally.weights, tally.activations, tally.traits(),
            run.stored, 4 * tally.activations, run.peak, parts=tally.parts(), read_again=tally.read_again,
        )  # fmt: skip
    return Workload(graphs, dict(runs))


@dataclass
class _Seen:
    """What one run of a graph did.

    Args:
        stored: Bytes of parameters and buffers, each once, in float32.
        where: Module (its ``id``) -> part of the policy.
        inside: Parts of the modules that are running, the innermost last.
        macs: Multiply-accumulates.
        alive: Bytes of intermediate tensors that exist now.
        peak: The most of them.
    """

    stored: int
    where: Mapping[int, str] = field(default_factory=dict)
    inside: list[str] = field(default_factory=list)
    tally: Tally = field(default_factory=Tally)
    macs: int = 0
    alive: int = 0
    peak: int = 0

    def product(self, macs: int, written: int, weights: int, groups: int = 1, weight: Hashable = "") -> None:
        self.macs += macs
        self.tally.add_layer(macs, written, weights, groups, self.inside[-1] if self.inside else "", weight)

    def keep(self, tensor: Any) -> None:
        size = tensor.numel() * tensor.element_size()
        self.alive += size
        self.peak = max(self.peak, self.alive)
        weakref.finalize(tensor, self._drop, size)

    def _drop(self, size: int) -> None:
        self.alive -= size


def _stored(module: Any) -> int:
    tensors = {id(tensor): tensor for tensor in (*module.parameters(), *module.buffers())}
    return sum(4 * tensor.numel() if tensor.is_floating_point() else tensor.numel() for tensor in tensors.values())


def _where(module: Any, parts: Mapping[str, Sequence[str]]) -> dict[int, str]:
    return {id(part): part_of(name, parts) for name, part in module.named_modules()} if parts else {}


@contextlib.contextmanager
def _watching(seen: _Seen) -> Iterator[None]:
    """Count every operator of torch, for the part of the policy whose module runs."""
    hooks = importlib.import_module("torch.nn.modules.module")

    def enter(module: Any, _inputs: Any) -> None:
        seen.inside.append(seen.where.get(id(module), ""))

    def leave(_module: Any, _inputs: Any, _outputs: Any) -> None:
        seen.inside.pop()

    handles = [
        hooks.register_module_forward_pre_hook(enter),
        hooks.register_module_forward_hook(leave, always_call=True),
    ]
    try:
        with _counting(seen):
            yield
    finally:
        for handle in handles:
            handle.remove()


def _counting(seen: _Seen) -> contextlib.AbstractContextManager[Any]:
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode

    class Watching(TorchDispatchMode):  # type: ignore[no-untyped-call]
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            output = func(*args, **(kwargs or {}))
            _count(torch, seen, func.overloadpacket.__name__, args, output)
            views = func.is_view or str(func).startswith("aten.detach")
            for tensor in output if isinstance(output, tuple | list) else (output,):
                if isinstance(tensor, torch.Tensor) and not views:
                    seen.keep(tensor)
            return output

    return Watching()  # type: ignore[no-untyped-call]


def _count(torch: Any, seen: _Seen, name: str, args: Any, output: Any) -> None:
    if name in PRODUCTS:
        first, second = args[PRODUCTS[name] : PRODUCTS[name] + 2]
        written, weight = output.numel(), _weight_of(second)
        seen.product(written * first.shape[-1], written, _weights(torch, second), weight=weight)
    elif name == "convolution":
        weight, groups, transposed = args[1], args[8], args[6]
        base = args[0].numel() if transposed else output.numel()
        seen.product(base * math.prod(weight.shape[1:]), output.numel(), weight.numel(), groups, _weight_of(weight))
    elif name.startswith(ATTENTION):
        query, key, value = args[:3]
        scores = math.prod(query.shape[:-1]) * key.shape[-2]
        seen.product(scores * query.shape[-1], scores, 0)
        seen.product(scores * value.shape[-1], math.prod(query.shape[:-1]) * value.shape[-1], 0)
    elif name == "cat":
        seen.tally.add_concat(concatenates=True)


def _weights(torch: Any, tensor: Any) -> int:
    """Return the numbers in a factor that is a parameter, or a view of one; 0 for an activation.

    A linear layer of strided rows is a batched product with its weight expanded over the batch: that counts once.
    """
    base = tensor._base if tensor._base is not None else tensor
    sizes = (size for size, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride)
    return math.prod(sizes) if isinstance(base, torch.nn.Parameter) else 0


def _weight_of(tensor: Any) -> Hashable:
    """Return what tells a factor from others: the tensor that it views, from where, in which shape."""
    base = tensor._base if tensor._base is not None else tensor
    return id(base), tensor.storage_offset(), math.prod(tensor.shape)
