"""The spec that is proposed where nobody wrote one: printed, and written as a ``policy.yaml`` to complete."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import typer

from vlatool.bundle.manifest import Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import UNKNOWN, TensorSpec
from vlatool.errors import OutputError
from vlatool.files.printable import printable
from vlatool.files.user_files import atomic_file

CHANNELS = (1, 3, 4)
SMALLEST_SIDE = 16
"""Pixels of a side from which on a tensor of channels looks like an image."""
IMAGE_RANK, VECTOR_RANK = 4, 2


def propose(typed: str, manifest: Manifest, out: Path | None) -> None:
    """Print the spec of a source that nobody described, and write it beside the output, as ``OUTPUT.policy.yaml``.

    A file that is there already stays.
    """
    from vlatool.sources import is_bundle, source_stage

    if is_bundle(typed) or source_stage(typed).describe() is not None:
        return
    file = out.with_name(f"{out.name}.policy.yaml") if out is not None else None
    text = proposal(manifest, os.path.relpath(typed, file.parent if file else Path()))
    where = "nothing is written without -o"
    if file is not None:
        where = f"{file}{_written(file, text)}"
    typer.echo(printable(f"proposed: no policy.yaml describes {typed} ({where})"), err=True)
    for line in text.splitlines():
        typer.echo(f"  {printable(line)}", err=True)


def _written(file: Path, text: str) -> str:
    """Write a proposal where no file is yet; return what is to be said of it."""
    if file.exists():
        return "" if file.read_text(encoding="utf-8") == text else ", which is there already, stays"
    try:
        with atomic_file(file) as draft:
            draft.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{file} cannot be written: {error.strerror}.", "name another output") from error
    return ""


def proposal(manifest: Manifest, source: str) -> str:
    """Return the text of a ``policy.yaml``; what the source does not say is named in comments.

    Args:
        source: the file that holds the policy, relative to the place of the text.
    """
    spec = manifest.spec
    lines = [
        "# Proposed by vlatool from what the source says. Complete what it does not: docs/guides/your-own-policy.md",
        "schema: 1",
        f"name: {json.dumps(manifest.name)}",
        f"version: {json.dumps(manifest.version)}",
        f"source: {json.dumps(source)}",
        "spec:",
        "  inputs:",
        *(f"    - {_flow(tensor)}  # {_looks(tensor)}" for tensor in spec.inputs),
        "  outputs:",
        *(f"    - {_flow(tensor)}{_open(tensor) if tensor is spec.action else ''}" for tensor in spec.outputs),
        f"  control_hz: {spec.control_hz if spec.control_hz is not None else UNKNOWN}",
        f"  chunk: {spec.chunk}",
        *([f"  execute: {spec.execute}"] if spec.execute else []),
    ]
    if manifest.program != single_graph(spec):
        lines += ["program:", *(f"  - {json.dumps(_step(step))}" for step in manifest.program)]
    return "\n".join(lines) + "\n"


def _step(step: Any) -> dict[str, Any]:
    return {key: value for key, value in vars(step).items() if value and not (key == "repeat" and value == 1)}


def _flow(tensor: TensorSpec) -> str:
    shown = {"name": tensor.name, "shape": list(tensor.shape), "dtype": tensor.dtype, **tensor.to_dict()}
    return json.dumps(shown)


def _open(tensor: TensorSpec) -> str:
    """Return a comment on what nobody said of the action."""
    words = [word for word in ("unit", "mode", "labels") if not getattr(tensor, word)]
    return f"  # the action; {', '.join(words)} unknown" if words else "  # the action"


def _looks(tensor: TensorSpec) -> str:
    """Return what an input looks like by its shape and dtype, and what is unknown of it."""
    axes, whole = tensor.shape, not tensor.dtype.startswith("float")
    sides = [axis for axis in axes[1:] if not isinstance(axis, int) or axis >= SMALLEST_SIDE]
    if len(axes) == IMAGE_RANK and len(sides) >= VECTOR_RANK and (axes[1] in CHANNELS or axes[3] in CHANNELS):
        layout = "first" if axes[1] in CHANNELS else "last"
        return f"looks like an image, channels {layout}; their order and range unknown"
    if whole and tensor.dtype in ("int64", "int32") and len(axes) == VECTOR_RANK:
        return "looks like tokens of a text; tokenizer unknown"
    if len(axes) <= VECTOR_RANK:
        return "looks like a state; unit and labels unknown" if not tensor.unit else "a state"
    return "meaning and unit unknown"
