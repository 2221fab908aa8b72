"""Removal of heads, neurons and channels from a traced module: its weights, and the sizes in its reshapes, are cut."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vlatool.errors import SourceError, require
from vlatool.files.printable import message_of
from vlatool.module._resizer import Resizer
from vlatool.module.axes import Walk
from vlatool.module.edit import REMAKE
from vlatool.module.factors import Shape
from vlatool.module.factory import map_user_exceptions
from vlatool.module.to_onnx import quiet_exporter

if TYPE_CHECKING:
    from torch import Tensor, nn

    from vlatool.module.edit import Edit

METADATA_ASSERTION = "_assert_tensor_metadata"
"""Operator that a trace has before each conversion: dtype and device as they were then, other ones in a training."""
RETRACE = "vlatool_retrace"
"""Attribute of a cut module that takes one batch size alone: gives the same module for another size."""


def trace_module(module: nn.Module, feeds: Sequence[Tensor]) -> Any:
    """Trace a module with torch.export.

    Args:
        module: module whose ``forward`` takes the feeds.
        feeds: tensors, the batch in front: free where it is larger than 1, and the module allows that.

    Raises:
        SourceError: when torch.export cannot trace it.
    """
    torch = require("torch", "build")
    axes = tuple({0: torch.export.Dim.AUTO} if feed.dim() and len(feed) > 1 else None for feed in feeds)
    named = _named_arguments(module, len(feeds))
    free = axes if named == len(feeds) else (*axes[:named], axes[named:])
    try:
        with quiet_exporter(), torch.no_grad(), map_user_exceptions("the policy's forward()"):
            return torch.export.export(module, tuple(feeds), dynamic_shapes=free, strict=False)
    except SourceError:
        raise
    except Exception as error:  # the seam: torch.export raises many foreign types
        reason = (message_of(error).splitlines() or [""])[0]
        raise SourceError(
            f"torch.export cannot trace {type(module).__name__}: {type(error).__name__}: {reason}.",
            "prune what needs no trace: vlatool prune depth, vlatool prune neurons",
        ) from error


def _named_arguments(module: nn.Module, count: int) -> int:
    """Return how many of so many arguments have a name in ``forward``; the others go to its ``*arguments``."""
    kinds = [parameter.kind for parameter in inspect.signature(module.forward).parameters.values()]
    several = inspect.Parameter.VAR_POSITIONAL
    return min(count, kinds.index(several)) if several in kinds else count


def remove_units(module: nn.Module, feeds: Sequence[Tensor], edits: Iterable[Edit]) -> nn.Module:
    """Return a module without the elements that edits do not keep.

    Args:
        module: module after the factory and the edits before these.
        feeds: example inputs, a batch of 1.
        edits: edits of weights, each with ``units AXIS.PLACE``: which factor of which of its axes; in a concatenation,
            ``.SEGMENT.PLACE`` follows.

    Raises:
        SourceError: when torch.export cannot trace it, or an edit does not fit.
    """
    wanted = list(edits)
    free = _for_any_batch(module, feeds, wanted)
    if free is not None:
        return free
    kept = _remove_units(module, feeds, wanted)
    _run(kept, feeds)

    def retrace(size: int) -> nn.Module:
        again = getattr(module, RETRACE, None)  # of one that lost units before
        other = _remove_units(again(size) if again else module, _repeat(feeds, size), wanted)
        _share(kept, other)
        return other

    setattr(kept, RETRACE, retrace)
    return kept


def _for_any_batch(module: nn.Module, feeds: Sequence[Tensor], edits: Sequence[Edit]) -> nn.Module | None:
    """Return the cut module for batches of any size, None where its code fixes the size."""
    torch = require("torch", "build")
    calls = map_user_exceptions("the policy's forward()")
    with contextlib.suppress(Exception), torch.no_grad(), calls:  # the seam: a user's module raises what it likes
        module(*_repeat(feeds, 2))
        made = _remove_units(module, _repeat(feeds, 2), edits)
        for size in (1, 3):
            made(*_repeat(feeds, size))
        return made
    return None


def _run(module: nn.Module, feeds: Sequence[Tensor]) -> None:
    """Run what is left of a module; where that fails, it is a fault of the cut and not of the policy."""
    torch = require("torch", "build")
    try:
        with torch.no_grad():
            module(*feeds)
    except Exception as error:  # the seam: any operator of torch
        reason = (message_of(error).splitlines() or [""])[0]
        raise RuntimeError(f"what pruning left of the module cannot run: {type(error).__name__}: {reason}") from error


def _repeat(feeds: Sequence[Tensor], size: int) -> list[Tensor]:
    return [feed.expand(size, *feed.shape[1:]).contiguous() if len(feed.shape) and len(feed) == 1 else feed
            for feed in feeds]  # fmt: skip


def _remove_units(module: nn.Module, feeds: Sequence[Tensor], edits: Sequence[Edit]) -> nn.Module:
    torch = require("torch", "build")
    program = trace_module(module, feeds)
    walk = Walk(program)
    keep = {_leaf(walk, edit): edit.keep for edit in edits}
    resizer = Resizer(walk, keep)
    for node in list(program.graph.nodes):
        if getattr(node.target, "_opname", "") == METADATA_ASSERTION:
            program.graph.erase_node(node)
        else:
            resizer.resize(node)
    state, cut_once = program.state_dict, dict[int, Any]()
    for name, shape in walk.weights.items():
        holder = state if name in state else program.constants
        value = holder[name]
        if id(value) not in cut_once:  # a tensor with several names stays one
            cut_once[id(value)] = _index_weight(walk, value, shape, keep)
        holder[name] = cut_once[id(value)]
    with quiet_exporter():
        made: nn.Module = torch.export.unflatten(program)
    return made


def _leaf(walk: Walk, edit: Edit) -> int:
    """Return the factor that an edit names."""
    axis, *path = edit.path
    shape = walk.weights.get(edit.module, [])
    atoms = {atom.path: atom.leaf for atom in walk.factors.atoms(shape[axis])} if axis < len(shape) else {}
    leaf = atoms.get(tuple(path))
    if leaf is None or walk.factors.is_frozen(leaf):
        raise SourceError(f"An edit names the {edit.axis} of '{edit.module}', which cannot be chosen.", REMAKE)
    if max(edit.keep) >= (size := walk.factors.sizes[leaf]):
        kept = f"numbered from 0; an edit keeps number {max(edit.keep)}"
        raise SourceError(f"The {edit.axis} of '{edit.module}' are {size}, {kept}.", REMAKE)
    return leaf


def _index_weight(walk: Walk, value: Any, shape: Shape, keep: Mapping[int, Sequence[int]]) -> Any:
    """Return a weight without what goes."""
    torch = require("torch", "build")
    smaller = value.detach()
    for number, axis in enumerate(shape):
        if any(atom.leaf in keep for atom in walk.factors.atoms(axis)):
            rows = torch.from_numpy(walk.factors.elements(axis, keep))
            smaller = smaller.index_select(number, rows.to(value.device)).contiguous()
    whole = isinstance(value, torch.nn.Parameter)
    return torch.nn.Parameter(smaller, value.requires_grad) if whole else smaller


def _share(source: nn.Module, target: nn.Module) -> None:
    """Let a module have the weights of another one, not copies."""
    parts = dict(source.named_modules())
    for name, part in target.named_modules():
        for holder in ("_parameters", "_buffers"):
            for key in getattr(part, holder):
                getattr(part, holder)[key] = getattr(parts[name], holder)[key]
