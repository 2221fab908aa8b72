"""Write the directory of a sample policy: description, vocabulary and recorded observations; needs no torch."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool import registry
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import require
from vlatool.samples._words import instructions, vocabulary

COUNTS = {"calibration": 48, "evaluation": 12}
GRIDS = ((3, 60.0), (8, 35.0), (28, 15.0))  # cells across the image, amplitude in grey levels
Ranges = Mapping[str, tuple[float, float]]


def write_sample(name: str, out: Path, seed: int = 0) -> None:
    """Write ``policy.yaml``, ``calibration.npz``, ``evaluation.npz`` and, for a policy that reads, ``vocabulary.json``.

    Args:
        name: A sample, with dashes or underscores: ``vit-s``.
        out: Fresh, writable directory.

    Raises:
        UsageError: when there is no such sample.
        MissingExtra: when PyYAML is absent.

    Example:
        >>> write_sample("vit-s", Path("vit-s"))  # doctest: +SKIP
    """
    module = registry.module("samples", name)
    spec = PolicySpec.from_dict(module.SPEC)
    key = module.__name__.rpartition(".")[2]
    _write_description(
        out / "policy.yaml", key, seed, module.DESCRIPTION, module.SPEC, getattr(module, "PROGRAM", None)
    )
    if any(tensor.kind == "text" for tensor in spec.inputs):
        text = json.dumps(vocabulary(), indent=1) + "\n"
        (out / "vocabulary.json").write_text(text, encoding="utf-8")
    for number, (part, count) in enumerate(COUNTS.items()):
        random = np.random.default_rng([seed, number])
        recorded = observations(spec, getattr(module, "RANGES", {}), count, random)
        np.savez_compressed(out / f"{part}.npz", allow_pickle=False, **recorded)


def _write_description(
    file: Path, key: str, seed: int, description: str, spec: dict[str, object], program: list[dict[str, object]] | None
) -> None:
    content: dict[str, Any] = {
        "schema": 1,
        "name": key.replace("_", "-"),
        "version": "0.0.0",
        "description": description,
        "source": f"vlatool.samples.{key}:make",
        "arguments": {"seed": seed},
        "spec": spec,
    }
    if program is not None:
        content["program"] = program
    text = require("yaml", "build").safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    file.write_text(text, encoding="utf-8")


def observations(spec: PolicySpec, ranges: Ranges, count: int, random: np.random.Generator) -> dict[str, NDArray[Any]]:
    """Draw raw observations.

    Args:
        spec: Inputs without free axes; pixels uint8, numbers float32, or text.
        ranges: Inputs that are uniform in a range; other numbers are standard normal.

    Returns:
        Input name -> (count, ...) in the place of the batch axis; text as unicode (count,).
    """
    return {tensor.name: _values(tensor, ranges.get(tensor.name), count, random) for tensor in spec.inputs}


def _values(
    tensor: TensorSpec, limits: tuple[float, float] | None, count: int, random: np.random.Generator
) -> NDArray[Any]:
    if tensor.kind == "text":
        return np.array(instructions(count, random))
    shape = tuple(int(axis) for axis in tensor.shape[1:])
    if tensor.dtype == "uint8":
        return np.stack([smooth_image(shape[0], shape[1], random) for _ in range(count)])
    if limits is not None:
        return random.uniform(*limits, (count, *shape)).astype(np.float32)
    return random.standard_normal((count, *shape), np.float32)


def smooth_image(height: int, width: int, random: np.random.Generator) -> NDArray[np.uint8]:
    """Return (height, width, 3) uint8: coarse to fine bilinear noise, whose spectrum falls as that of photographs."""
    image = np.full((height, width, 3), random.uniform(90, 165, 3))
    for cells, amplitude in GRIDS:
        grid = random.standard_normal((cells + 1, cells + 1, 3))
        rows, columns = _interpolation(height, cells), _interpolation(width, cells)
        image += amplitude * np.einsum("hi,ijc,wj->hwc", rows, grid, columns, optimize=True)
    pixels: NDArray[np.uint8] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return pixels


def _interpolation(length: int, cells: int) -> NDArray[np.float64]:
    """(length, cells + 1): weights of the grid points at each pixel."""
    positions = np.linspace(0, cells, length)[:, None]
    return np.maximum(0.0, 1.0 - np.abs(positions - np.arange(cells + 1)))
