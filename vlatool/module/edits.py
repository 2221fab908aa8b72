"""What a bundle changes in the modules that a factory makes: which channels are kept, and the weights.

``module/edits.json`` is an ordered list of structural edits, ``module/GRAPH.safetensors`` the weights of a graph's
module after them. A module is always made in this order: the factory, the edits, the weights. Without the second file
the weights are those of the policy's shards (``module.sharded_weights``): blocks that are kept have them already.
"""

from __future__ import annotations

import json
import math
import os
import re
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, SourceError, require, suggest
from vlatool.files.json import read_json
from vlatool.files.printable import amount
from vlatool.module.edit import REMAKE
from vlatool.module.edit import Edit as Edit
from vlatool.module.feeds import first_feeds
from vlatool.module.unit_removal import remove_units

if TYPE_CHECKING:
    from torch import Tensor, nn

FOLDER = "module"
EDITS = f"{FOLDER}/edits.json"
CHANNELS, BLOCKS = ("outputs", "inputs"), "blocks"
AXIS = re.compile(rf"{'|'.join(CHANNELS)}|{BLOCKS}|units(?:@[1-9]\d?)? \d(?:\.\d+\.\d+)*\.\d+")
FORM = (
    "graph and module (names), axis (outputs, inputs, blocks, or 'units A.P' with numbers) and keep (different whole "
    "numbers from 0)"
)
MAX_LISTED = 20
"""Names of modules that a message lists."""
SIZES = {"outputs": ("out_features", "out_channels", "num_features"), "inputs": ("in_features", "in_channels")}
"""Axis -> attributes of a module that say its size."""


SAFETENSORS_DTYPES = {"torch.float32": "F32", "torch.float64": "F64", "torch.float16": "F16", "torch.bfloat16": "BF16"}
"""Type of a weight that is trained -> as safetensors calls it."""
_CHANGED_MODULES: weakref.WeakSet[Any] = weakref.WeakSet()
"""Modules that were changed in this process."""


def is_changed(bundle: Bundle) -> bool:
    """Return whether a bundle has modules other than those that its factory makes."""
    return any(name.startswith(f"{FOLDER}/") for name in bundle.manifest.files)


def holds_weights(bundle: Bundle) -> bool:
    """Return whether a bundle holds weights of its modules, other than those of its policy."""
    return any(name.startswith(f"{FOLDER}/") and name.endswith(".safetensors") for name in bundle.manifest.files)


def read_edits(bundle: Bundle) -> tuple[Edit, ...]:
    """Return the structural edits of a bundle; raises SourceError when the file is invalid."""
    if EDITS not in bundle.manifest.files:
        return ()
    path = bundle.file(EDITS)
    return edits_from(path.read_bytes(), str(path))


def edits_from(text: str | bytes, where: str) -> tuple[Edit, ...]:
    """Return the edits of a JSON list; raises SourceError when it is not one."""
    content = text.encode() if isinstance(text, str) else text
    listed = read_json(content, where, SourceError, REMAKE, strict=True)
    if not isinstance(listed, list):
        raise SourceError(f"{where} must hold a list of edits; got {type(listed).__name__}.", REMAKE)
    return tuple(_edit(entry, where) for entry in listed)


def _edit(value: Any, where: str) -> Edit:
    if not _is_edit(value):
        raise SourceError(f"{where} has an invalid edit: {json.dumps(value)[:200]}; wanted {FORM}.", REMAKE)
    return Edit(str(value["graph"]), str(value["module"]), value["axis"], tuple(value["keep"]))


def _is_edit(value: Any) -> bool:
    if not isinstance(value, Mapping) or set(value) != set(Edit.__dataclass_fields__):
        return False
    keep = value["keep"]
    if not isinstance(keep, list) or not keep or not AXIS.fullmatch(str(value["axis"])):
        return False
    whole = all(isinstance(index, int) and not isinstance(index, bool) and index >= 0 for index in keep)
    return whole and len(set(keep)) == len(keep)


def apply_bundle(modules: Mapping[str, nn.Module], bundle: Bundle, *, weights: bool = True) -> dict[str, nn.Module]:
    """Change what the factory made as a bundle says.

    Args:
        modules: graph name -> module, which is changed in place, or replaced where it must be traced.
        bundle: bundle with edits, weights, both or neither.
        weights: whether its weights are loaded, too; without them, only the structure counts.

    Raises:
        SourceError: when an edit or a tensor does not fit the module, or the factory gives one that was changed before.
    """
    for graph, module in modules.items():
        if module in _CHANGED_MODULES:
            raise SourceError(
                f"The factory gives the same module each time that it is called: '{graph}' was changed already.",
                "let it make a new module each time",
            )
    made = apply(modules, read_edits(bundle), bundle)
    for graph, module in made.items() if weights else ():
        if (name := f"{FOLDER}/{graph}.safetensors") in bundle.manifest.files:
            path = bundle.file(name)
            load_tensors(graph, module, read_tensors(path), str(path))
    return made


edited = apply_bundle
"""Old name, for code outside vlatool."""


def apply(
    modules: Mapping[str, nn.Module], edits: Iterable[Edit], bundle: Bundle | None = None
) -> dict[str, nn.Module]:
    """Keep what each edit says, in order.

    Args:
        modules: graph name -> module, changed in place, or replaced where it must be traced.
        bundle: bundle whose policy runs once for the trace where a module loses units; other edits do not need it.

    Raises:
        SourceError: when there is no such module, it has no such axis or fewer channels or blocks.
    """
    made = dict(modules)
    for trace, group in groupby(edits, lambda edit: edit.trace):
        if trace:
            if bundle is None:
                raise ValueError("a module that loses units is traced, which takes an observation: name the bundle")
            made = _without_units(made, tuple(group), bundle)
            continue
        for edit in group:
            parts = dict(_graph_module(made, edit.graph).named_modules())
            if edit.module not in parts:
                known = [name for name in parts if name][:MAX_LISTED]
                more = f" and {len(parts) - 1 - len(known)} more" if len(parts) - 1 > len(known) else ""
                says = f"An edit names the module '{edit.module}'; {suggest(edit.module, known)}{more}."
                raise SourceError(says, REMAKE)
            _CHANGED_MODULES.add(made[edit.graph])
            (_keep_blocks if edit.axis == BLOCKS else _keep)(parts[edit.module], edit)
    return made


def _graph_module(modules: Mapping[str, nn.Module], graph: str) -> nn.Module:
    if graph not in modules:
        raise SourceError(f"An edit names the graph '{graph}'; {suggest(graph, modules)}.", REMAKE)
    return modules[graph]


def _without_units(modules: Mapping[str, nn.Module], edits: Sequence[Edit], bundle: Bundle) -> dict[str, nn.Module]:
    """Trace the modules that lose units, and cut them."""
    feeds = first_feeds(modules, bundle)
    made = dict(modules)
    for graph in dict.fromkeys(edit.graph for edit in edits):
        own = [edit for edit in edits if edit.graph == graph]
        made[graph] = remove_units(_graph_module(modules, graph), feeds[graph], own)
    return made


def loses_units(edits: Iterable[Edit]) -> bool:
    """Say whether a module must be traced to be edited so."""
    return any(edit.trace for edit in edits)


def refuse_traced(bundle: Bundle, what: str, command: str) -> None:
    """Refuse a policy that lost units: its parts are those of a trace, and not of the classes that it was made of.

    Raises:
        RecipeError: naming the order that works.
    """
    if loses_units(read_edits(bundle)):
        raise RecipeError(
            f"{bundle.manifest.name} lost heads, neurons or channels before: it is a trace since, in which {what} "
            "cannot be found.",
            f"run {command} first, and vlatool prune structured or vlatool prune latency on what it makes",
        )


def concatenate_edits(before: Sequence[Edit], after: Sequence[Edit]) -> tuple[Edit, ...]:
    """Return edits that do what those before and those after them do; the units of the latter are of another trace."""
    traces = max((edit.trace for edit in before), default=0)
    return (*before, *(edit.after(traces) for edit in after))


def _keep(module: Any, edit: Edit) -> None:
    torch = require("torch", "build")
    size = next((name for name in SIZES[edit.axis] if hasattr(module, name)), "")
    if not size or getattr(module, "groups", 1) != 1 or getattr(module, "transposed", False):
        raise SourceError(f"The {edit.axis} of '{edit.module}' ({type(module).__name__}) cannot be chosen.", REMAKE)
    if max(edit.keep) >= getattr(module, size):
        has = f"'{edit.module}' has {getattr(module, size)} {edit.axis}"
        raise SourceError(f"{has}, numbered from 0; an edit keeps number {max(edit.keep)}.", REMAKE)
    axis = CHANNELS.index(edit.axis)
    for holder in (module._parameters, module._buffers):
        for name, value in holder.items():
            if value is not None and value.dim() > axis and (axis == 0 or name == "weight"):
                index = torch.tensor(edit.keep, device=value.device)
                kept = value.detach().index_select(axis, index).contiguous()
                holder[name] = torch.nn.Parameter(kept, value.requires_grad) if holder is module._parameters else kept
    setattr(module, size, len(edit.keep))


def _keep_blocks(module: Any, edit: Edit) -> None:
    """Keep blocks; those of a list, and those that are numbered, are numbered anew."""
    nn = require("torch", "build").nn
    if not isinstance(module, nn.ModuleList | nn.Sequential):
        kind = type(module).__name__
        said = f"The blocks of '{edit.module}' ({kind}) cannot be chosen: it is not an nn.ModuleList or nn.Sequential."
        raise SourceError(said, REMAKE)
    blocks = list(module._modules.items())
    if max(edit.keep) >= len(blocks):
        has = f"'{edit.module}' has {amount(len(blocks), 'block')}, numbered from 0"
        raise SourceError(f"{has}; an edit keeps number {max(edit.keep)}.", REMAKE)
    module._modules.clear()
    for number, index in enumerate(edit.keep):
        name, block = blocks[index]
        module._modules[str(number) if name.isdecimal() else name] = block


def read_tensors(path: Path) -> dict[str, Any]:
    """Return name -> tensor of a safetensors file; raises SourceError when it is unreadable or another format."""
    safetensors = require("safetensors.torch", "build")
    try:
        return dict(safetensors.load_file(str(path)))
    except Exception as error:  # the seam: safetensors raises its own kind
        raise SourceError(
            f"{path} cannot be read as safetensors: {error}.",
            "write it again with safetensors.torch.save_file(), or make the bundle again",
        ) from error


def load_tensors(graph: str, module: nn.Module, stored: Mapping[str, Any], where: str) -> None:
    """Fill a module from tensors that are named as in ``state_dict()``, or ``GRAPH.`` before that.

    A tensor with several names in the module is taken from the first of them that is stored.

    Raises:
        SourceError: when a tensor is missing or has another shape.
    """
    tensors: dict[str, Tensor] = {}
    held = module.state_dict(keep_vars=True)
    for first, names in names_of_each(held):
        value, found = held[first], (stored.get(f"{graph}.{each}", stored.get(each)) for each in names)
        tensor = next((each for each in found if each is not None), None)
        if tensor is None:
            raise SourceError(
                f"No tensor of {where} is '{first}' of '{graph}'; {suggest(first, stored)}.",
                "store the state_dict of the module that make() gives, with its names",
            )
        if tensor.shape != value.shape:
            got, want = list(tensor.shape), list(value.shape)
            raise SourceError(
                f"'{first}' has the shape {got} in {where}; the module's is {want}.",
                "store the state_dict of the module that make() gives, with its shapes",
            )
        tensors |= dict.fromkeys(names, tensor.to(value.dtype))
    module.load_state_dict(tensors)


def save_tensors(path: Path, tensors: Mapping[str, Any], about: Mapping[str, str] | None = None) -> None:
    """Write a safetensors file.

    Args:
        tensors: name -> tensor.
        about: texts that go with them.

    Raises:
        OSError: when it cannot be written; what there is of it stays.
    """
    safetensors = require("safetensors", "build")
    try:
        require("safetensors.torch", "build").save_file(dict(tensors), str(path), dict(about) if about else None)
    except safetensors.SafetensorError as error:
        number = re.search(r"\(os error (\d+)\)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error


def stream_tensors(
    path: Path, forms: Mapping[str, tuple[Any, Sequence[int]]], tensors: Iterable[Tensor], about: Mapping[str, str]
) -> None:
    """Write a safetensors file of tensors that come one after the other, so that one is in memory at a time.

    Args:
        forms: name -> dtype and shape, in the order in which they come.
        about: texts that go with them.

    Raises:
        OSError: when it cannot be written; what there is of it stays.
    """
    torch = require("torch", "build")
    header: dict[str, Any] = {"__metadata__": dict(about)}
    end = 0
    for name, (dtype, shape) in forms.items():
        start, end = end, end + math.prod(shape) * dtype.itemsize
        header[name] = {"dtype": SAFETENSORS_DTYPES[str(dtype)], "shape": list(shape), "data_offsets": [start, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as stream:
        stream.write(len(text).to_bytes(8, "little") + text)
        for tensor in tensors:
            stream.write(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)


def names_of_each(state: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Return the first name and all names of each tensor of a module: tied weights have several."""
    names: dict[int, list[str]] = {}
    for name, value in state.items():
        names.setdefault(id(value), []).append(name)
    return [(listed[0], listed) for listed in names.values()]


def write_module(out: Path, edits: Sequence[Edit], modules: Mapping[str, nn.Module]) -> None:
    """Write the edits and the weights of the modules to a new bundle; no modules where the weights stay in shards."""
    (out / FOLDER).mkdir()
    (out / EDITS).write_text(json.dumps([asdict(edit) for edit in edits]) + "\n", encoding="utf-8")
    for graph, module in modules.items():
        held = module.state_dict(keep_vars=True)
        tensors = _separate_memory({first: held[first] for first, _ in names_of_each(held)})
        path = out / FOLDER / f"{graph}.safetensors"
        save_tensors(path, tensors)
        path.chmod((out / EDITS).stat().st_mode & 0o777)  # safetensors lets nobody else read it


def _separate_memory(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors that share no memory, as a file of them needs; those that share none are not copied."""
    seen: set[int] = set()
    apart = {}
    for name, value in state.items():
        held = value.detach().contiguous()
        pointer = held.untyped_storage().data_ptr()
        apart[name] = held.clone() if pointer in seen else held
        seen.add(pointer)
    return apart
