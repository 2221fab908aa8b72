"""What a bundle changes in the modules that a factory makes: which channels are kept, and the weights.

``module/edits.json`` is an ordered list of structural edits, ``module/GRAPH.safetensors`` the weights of a graph's
module after them. A module is always made in this order: the factory, the edits, the weights.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError, nearest, require
from vlatool.files.json import read_json

if TYPE_CHECKING:
    from torch import nn

FOLDER = "module"
EDITS = f"{FOLDER}/edits.json"
AXES = ("outputs", "inputs")
SIZES = {"outputs": ("out_features", "out_channels", "num_features"), "inputs": ("in_features", "in_channels")}
"""Axis -> attributes of a module that say its size."""


@dataclass(frozen=True)
class Edit:
    """Channels of one module that are kept.

    Args:
        graph: Name of the graph whose module it is in.
        module: Its name, as ``named_modules`` gives it.
        axis: ``outputs`` (rows of the weight, the bias) or ``inputs`` (columns of the weight).
        keep: Indices of the channels that stay, in the order in which they stay.
    """

    graph: str
    module: str
    axis: str
    keep: tuple[int, ...]


def is_changed(bundle: Bundle) -> bool:
    """Return whether a bundle has modules other than those that its factory makes."""
    return any(name.startswith(f"{FOLDER}/") for name in bundle.manifest.files)


def read_edits(bundle: Bundle) -> tuple[Edit, ...]:
    """Return the structural edits of a bundle.

    Raises:
        SourceError: when the file is invalid.
    """
    if EDITS not in bundle.manifest.files:
        return ()
    path = bundle.file(EDITS)
    listed = read_json(path.read_bytes(), str(path), SourceError, "make the bundle again")
    if not isinstance(listed, list):
        raise SourceError(f"{path} must hold a list of edits; got {type(listed).__name__}.")
    return tuple(_edit(entry, path) for entry in listed)


def _edit(value: Any, path: Path) -> Edit:
    known = set(Edit.__dataclass_fields__)
    fits = isinstance(value, Mapping) and set(value) == known and isinstance(value["keep"], list)
    whole = fits and all(
        isinstance(index, int) and not isinstance(index, bool) and index >= 0 for index in value["keep"]
    )
    if not whole or not value["keep"] or len(set(value["keep"])) != len(value["keep"]) or value["axis"] not in AXES:
        raise SourceError(f"{path} has an invalid edit: {json.dumps(value)[:200]}.")
    return Edit(str(value["graph"]), str(value["module"]), value["axis"], tuple(value["keep"]))


def edited(modules: Mapping[str, nn.Module], bundle: Bundle, *, weights: bool = True) -> dict[str, nn.Module]:
    """Change what the factory made as a bundle says.

    Args:
        modules: Graph name -> module, which is changed in place.
        bundle: With edits, weights, both or none.
        weights: Whether its weights are loaded, too; without them, only the structure counts.

    Raises:
        SourceError: when an edit or a tensor does not fit the module.
    """
    apply(modules, read_edits(bundle))
    for graph, module in modules.items() if weights else ():
        if (name := f"{FOLDER}/{graph}.safetensors") in bundle.manifest.files:
            path = bundle.file(name)
            load_tensors(graph, module, read_tensors(path), str(path))
    return dict(modules)


def apply(modules: Mapping[str, nn.Module], edits: Iterable[Edit]) -> None:
    """Keep the channels of each edit, in order; modules are changed in place.

    Raises:
        SourceError: when there is no such module, it has no such axis, or fewer channels.
    """
    for edit in edits:
        if edit.graph not in modules:
            raise SourceError(f"An edit names the graph '{edit.graph}'; {nearest(edit.graph, modules)}.")
        parts = dict(modules[edit.graph].named_modules())
        if edit.module not in parts:
            raise SourceError(f"An edit names the module '{edit.module}'; {nearest(edit.module, list(parts)[:500])}.")
        _keep(parts[edit.module], edit)


def _keep(module: Any, edit: Edit) -> None:
    torch = require("torch", "build")
    size = next((name for name in SIZES[edit.axis] if hasattr(module, name)), "")
    if not size or getattr(module, "groups", 1) != 1 or getattr(module, "transposed", False):
        raise SourceError(f"The {edit.axis} of '{edit.module}' ({type(module).__name__}) cannot be chosen from.")
    if max(edit.keep) >= getattr(module, size):
        raise SourceError(f"'{edit.module}' has {getattr(module, size)} {edit.axis}; an edit keeps {max(edit.keep)}.")
    axis = AXES.index(edit.axis)
    for holder in (module._parameters, module._buffers):
        for name, value in holder.items():
            if value is not None and value.dim() > axis and (axis == 0 or name == "weight"):
                index = torch.tensor(edit.keep, device=value.device)
                kept = value.detach().index_select(axis, index).contiguous()
                holder[name] = torch.nn.Parameter(kept, value.requires_grad) if holder is module._parameters else kept
    setattr(module, size, len(edit.keep))


def read_tensors(path: Path) -> dict[str, Any]:
    """Return the tensors of a safetensors file: name -> tensor.

    Raises:
        SourceError: when the file cannot be read, or is not safetensors.
    """
    safetensors = require("safetensors.torch", "build")
    try:
        return dict(safetensors.load_file(str(path)))
    except Exception as error:  # the seam: safetensors raises its own kind
        raise SourceError(f"{path} cannot be read as safetensors: {error}.") from error


def load_tensors(graph: str, module: nn.Module, stored: Mapping[str, Any], where: str) -> None:
    """Fill a module from tensors that are named as in ``state_dict()``, or ``GRAPH.`` before that.

    Raises:
        SourceError: when a tensor is missing or has another shape.
    """
    tensors = {}
    for name, value in module.state_dict().items():
        tensor = stored.get(f"{graph}.{name}", stored.get(name))
        if tensor is None:
            raise SourceError(f"No tensor of {where} is '{name}' of '{graph}'; {nearest(name, stored)}.")
        if tensor.shape != value.shape:
            got, want = list(tensor.shape), list(value.shape)
            raise SourceError(f"'{name}' has the shape {got} in {where}; the module's is {want}.")
        tensors[name] = tensor.to(value.dtype)
    module.load_state_dict(tensors)


def write_module(out: Path, edits: Sequence[Edit], modules: Mapping[str, nn.Module]) -> None:
    """Write the edits and the weights of the modules to a new bundle."""
    safetensors = require("safetensors.torch", "build")
    (out / FOLDER).mkdir()
    (out / EDITS).write_text(json.dumps([asdict(edit) for edit in edits]) + "\n", encoding="utf-8")
    for graph, module in modules.items():
        tensors = {name: value.detach().contiguous().clone() for name, value in module.state_dict().items()}
        path = out / FOLDER / f"{graph}.safetensors"
        safetensors.save_file(tensors, str(path))
        path.chmod((out / EDITS).stat().st_mode & 0o777)  # safetensors lets nobody else read it
