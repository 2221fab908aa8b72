"""The golden file of a bundle: observations, with the noise of each, and the actions that the graphs gave for them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError, suggest
from vlatool.files.limits import check_limit
from vlatool.files.npz import open_npz

COPY_AGAIN = "copy the bundle again from where it was made, or make it again"

GOLDEN_STEPS = 2
"""Golden observations in a row that a program with kept values needs: the first alone does not show what was kept."""
CHUNK, ROBOT_CHUNK = "chunk", "robot_chunk"
"""Prefixes of actions in physical units: before they are converted, and as the robot gets them."""
Array = NDArray[Any]
Golden = tuple[dict[str, Any], dict[str, Array], Array]
"""Observation, noise, raw action output."""


def load_golden(bundle: Bundle) -> Golden | None:
    """Return the first of ``load_goldens``, None when the bundle has none."""
    return next(iter(load_goldens(bundle)), None)


def load_goldens(bundle: Bundle) -> list[Golden]:
    """Return every golden (observation, noise, raw action output), in the order in which they follow a reset.

    Raises:
        BundleError: when the file is not the one that the manifest records.
        DataError: when the file cannot be read or does not fit the spec.
    """
    return golden_steps(bundle, golden_arrays(bundle))


def golden_arrays(bundle: Bundle) -> Mapping[str, Array]:
    """Return the arrays of the golden file, if any; raises BundleError when it is not the one in the manifest."""
    name = bundle.manifest.golden
    if not name:
        return {}
    return open_npz(
        bundle.read(name, "golden_bytes"), "golden_bytes", where=f"The golden file {bundle.path / name}", fix=COPY_AGAIN
    )


def golden_steps(bundle: Bundle, stored: Mapping[str, Array]) -> list[Golden]:
    """Return what each step of the golden file's arrays holds, in the order in which they follow a reset.

    Raises:
        DataError: when the file does not fit the spec.
    """
    name, spec = bundle.manifest.golden, bundle.manifest.spec
    if not name:
        return []
    where = f"The golden file {bundle.path / name}"
    noise = [key for key in stored if key.startswith("noise.")]
    action = f"out.{spec.action.name}"
    needed = [*(f"in.{tensor.name}" for tensor in spec.inputs), *noise, action]
    for key in needed:
        if key not in stored:
            raise DataError(f"{where} cannot be read: it has no '{key}'; {suggest(key, stored)}.", COPY_AGAIN)
        numbers = stored[key].dtype.kind in "fiu" or (key not in noise and key != action)
        if not stored[key].ndim or not len(stored[key]) or not numbers:
            raise DataError(f"{where} cannot be read: '{key}' has no steps, or no numbers.", COPY_AGAIN)
    counts = {len(stored[key]) for key in needed}
    if len(counts) > 1:
        raise DataError(f"{where} cannot be read: its arrays have {sorted(counts)} steps.", COPY_AGAIN)
    check_limit("golden_steps", max(counts), where, DataError)
    return [
        (
            {tensor.name: stored[f"in.{tensor.name}"][step] for tensor in spec.inputs},
            {key.removeprefix("noise."): stored[key][step] for key in noise},
            stored[action][step],
        )
        for step in range(counts.pop())
    ]


def golden_chunks(action: TensorSpec, stored: Mapping[str, Array], steps: int, kind: str = CHUNK) -> list[Array]:
    """Return the recorded actions in physical units; none for indices, and where they were not recorded.

    Args:
        kind: ``CHUNK``, before they are converted, or ``ROBOT_CHUNK``, as the robot gets them.
    """
    chunks = stored.get(f"{kind}.{action.name}")
    if chunks is None or action.kind == "discrete" or not chunks.ndim or chunks.dtype.kind not in "fiu":
        return []
    return list(chunks) if len(chunks) == steps else []


def conversion_error(got: Array, expected: Array) -> float:
    """Return how far two conversions of one action are apart: the worst element, relative to its own size.

    An element is taken as 1 % of the largest at least: what is left where large numbers cancel is rounding. Infinite
    when their sizes differ.

    Args:
        got: (T, A) in the units of the robot.
        expected: the same.
    """
    one, other = (np.asarray(each, np.float64).reshape(-1, each.shape[-1]) for each in (got, expected))
    if one.shape != other.shape:
        return math.inf
    sizes = np.abs(other).max(axis=0, initial=0.0)
    least = 0.01 * float(sizes.max(initial=0.0)) or 1.0
    return float((np.abs(one - other).max(axis=0, initial=0.0) / np.maximum(sizes, least)).max(initial=0.0))
