"""Modules whose weights stay in the policy's shards even after blocks are removed: their location, and how to run them.

The shards are named after what the factory makes. An edit that keeps blocks moves modules and makes no tensor, so each
tensor of the edited module is found under the name that it had before.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError, require, suggest
from vlatool.module.edits import BLOCKS, holds_weights, is_changed, read_edits
from vlatool.module.fake_weights import MetaModules, make_meta_modules
from vlatool.module.origin import RESTART, origin_of
from vlatool.weights.shards import NUMPY_NAMES, Reader, StoredTensor, read_shards, sampled_hash, shard_files

if TYPE_CHECKING:
    from torch import Tensor, nn

PART_BYTES = 1 << 24
"""Bytes that are read of a tensor at once, in addition to the tensor itself."""
Locations = dict[str, dict[str, StoredTensor]]
"""Graph name -> name in ``state_dict()`` of the edited module -> where the bytes are."""


@dataclass(frozen=True)
class StoredModules:
    """Modules, graph name -> module with parameters on torch's meta device, and where their weights are."""

    modules: dict[str, nn.Module]
    locations: Locations

    @property
    def nbytes(self) -> int:
        """Bytes of all weights in the shards, each counted once."""
        tensors = (tensor for graph in self.locations.values() for tensor in graph.values())
        return sum({(tensor.file, tensor.offset): tensor.nbytes for tensor in tensors}.values())


def policy_weights(bundle: Bundle) -> tuple[Path, str]:
    """Return the folder of a policy's code and the glob of its weights; empty when the factory loads them itself."""
    origin = origin_of(bundle)
    return origin.folder, origin.weights


def takes_shards(bundle: Bundle) -> bool:
    """Return whether all weights of a bundle's modules are in shards that its policy describes."""
    if bundle.manifest.graphs or "factory" not in bundle.manifest.source or holds_weights(bundle):
        return False
    return bool(policy_weights(bundle)[1]) and all(edit.axis == BLOCKS for edit in read_edits(bundle))


def stored_modules(bundle: Bundle) -> StoredModules:
    """Make the modules of a bundle whose weights are in shards, without reading a weight.

    Raises:
        SourceError: when code or shards have changed, the factory fails, or shards and modules do not fit together.
    """
    folder, pattern = policy_weights(bundle)
    shards = read_shards(folder, pattern)
    recorded = bundle.manifest.source.get("shards")
    if is_changed(bundle) and recorded != sampled_hash(shard_files(folder, pattern)):
        raise SourceError(f"The weights in {folder} have changed since {bundle.path} was made.", RESTART)
    made = make_meta_modules(bundle)
    locations = {graph: _locate(graph, made, shards, folder / "policy.yaml") for graph in made.modules}
    return StoredModules(made.modules, locations)


def _locate(graph: str, made: MetaModules, shards: Mapping[str, StoredTensor], file: Path) -> dict[str, StoredTensor]:
    """Return where the bytes of every parameter and saved buffer are: name -> tensor."""
    names: dict[int, list[str]] = {}
    for name, value in made.made[graph]:
        names.setdefault(id(value), []).append(name)
    locations = {}
    for name, value in made.modules[graph].state_dict(keep_vars=True).items():
        known = names[id(value)]
        before = [name, *known] if name in known else known
        found = (shards.get(f"{graph}.{each}") or shards.get(each) for each in before)
        tensor = next((each for each in found if each is not None), None)
        if tensor is None:
            raise SourceError(
                f"No shard holds '{before[0]}', which the module '{graph}' needs; {suggest(before[0], shards)}.",
                f"names are those of state_dict(); check the weights and the arguments in {file}",
            )
        if tuple(value.shape) != tensor.shape:
            raise SourceError(
                f"'{tensor.name}' in {tensor.file.name} has the shape {list(tensor.shape)}; the module built by the "
                f"factory wants {list(value.shape)}.",
                "check the factory's arguments in policy.yaml",
            )
        locations[name] = tensor
    return locations


def read_tensor(reader: Reader, stored: StoredTensor, dtype: Any) -> Tensor:
    """Read a tensor in another dtype, a part at a time."""
    torch = require("torch", "build")
    kinds = {kind: getattr(torch, name) for name, kind in NUMPY_NAMES.items()}
    if stored.dtype not in kinds:
        raise SourceError(
            f"'{stored.name}' in {stored.file.name} is {stored.dtype}; torch modules cannot hold that.",
            "store it as float32, float16 or bfloat16",
        )
    whole = torch.empty(stored.shape, dtype=dtype)
    flat = whole.view(-1)
    for begin in range(0, stored.nbytes, PART_BYTES):
        raw = torch.from_numpy(reader.read(stored, begin, min(PART_BYTES, stored.nbytes - begin)))
        part = raw.view(kinds[stored.dtype])
        first = begin // stored.item_bytes
        flat[first : first + len(part)] = part
    return whole  # type: ignore[no-any-return]


def fill_modules(stored: StoredModules) -> dict[str, nn.Module]:
    """Read all weights into the modules, one tensor after the other."""
    _replace(stored, stored.modules, _read(_values(stored, stored.modules)))
    return stored.modules


@contextlib.contextmanager
def graph_weights(stored: StoredModules, graph: str) -> Iterator[None]:
    """Within this, the module of one graph has its weights; afterwards it has none, as before."""
    weights = _read(_values(stored, (graph,)))
    _replace(stored, (graph,), weights)
    try:
        yield
    finally:
        _replace(stored, (graph,), {id(full): (full, empty) for empty, full in weights.values()})
        del weights
        gc.collect()  # what an exporter made of them refers to itself


def _read(values: Iterable[tuple[Tensor, StoredTensor]]) -> dict[int, tuple[Tensor, Tensor]]:
    """Fill saved buffers; return ``id`` of each weight -> the weight without its values, and with them."""
    torch = require("torch", "build")
    weights = {}
    with Reader() as reader, torch.no_grad():
        for value, tensor in values:
            read = read_tensor(reader, tensor, value.dtype)
            if value.is_meta:
                weights[id(value)] = value, torch.nn.Parameter(read, value.requires_grad)
            else:
                value.copy_(read)
    return weights


def _replace(stored: StoredModules, graphs: Iterable[str], weights: Mapping[int, tuple[Tensor, Tensor]]) -> None:
    """Replace the weights that are identified by ``id`` in every module that has them."""
    for graph in graphs:
        for part in stored.modules[graph].modules():
            for name, value in list(part._parameters.items()):
                if id(value) in weights:
                    setattr(part, name, weights[id(value)][1])


def _values(stored: StoredModules, graphs: Iterable[str]) -> Iterator[tuple[Tensor, StoredTensor]]:
    """Yield each parameter and saved buffer of some graphs once, with its place."""
    seen = set()
    for graph in graphs:
        for name, value in stored.modules[graph].state_dict(keep_vars=True).items():
            if id(value) not in seen:
                seen.add(id(value))
                yield value, stored.locations[graph][name]


@contextlib.contextmanager
def weights_on_demand(stored: StoredModules) -> Iterator[None]:
    """Run modules within this: a function that is given a weight gets it from its shard, for that call alone."""
    torch = require("torch", "build")
    from torch.overrides import TorchFunctionMode
    from torch.utils._pytree import tree_map

    with Reader() as reader:
        values = list(_values(stored, stored.modules))
        locations = {id(value): tensor for value, tensor in values if value.is_meta}
        _read((value, tensor) for value, tensor in values if not value.is_meta)

        def load(value: Any) -> Any:
            if id(value) not in locations:
                return value
            return read_tensor(reader, locations[id(value)], value.dtype)

        class Reading(TorchFunctionMode):
            def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
                if getattr(func, "__name__", "") == "__get__":  # an attribute, such as shape, device or T
                    given = func(*args)
                    if not isinstance(given, torch.Tensor):
                        return torch.device("cpu") if given == torch.device("meta") else given
                return func(*tree_map(load, args), **tree_map(load, kwargs or {}))

        with Reading():
            yield
