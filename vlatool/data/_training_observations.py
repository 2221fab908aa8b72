"""Observations that a training saw, as the graphs take them: ranges of activations are taken from these, too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError
from vlatool.files.npz import open_npz
from vlatool.runtime.observation import EncodedObservation

Array = NDArray[Any]
OBSERVATIONS_FILE = "data/played.npz"
BEGINS = "(begins)"
"""Array that says of each row whether an episode begins with it, where the policy keeps values."""
MAX_PLAYED = 128
"""Observations that are kept: twice those that calibrate by default."""
MIN_PLAYED = 16
BYTES = 64 << 20
"""Of observations beyond ``MIN_PLAYED``, before they are compressed: large images are kept fewer."""


class Encoded(EncodedObservation):
    """An observation as the graphs take it, name -> (1, ...): normalised, text as ids."""

    begins = True
    """Whether an episode begins with it, or nothing before it is known."""


REMEDY = "train again: quantize qat writes it"


def kept_rows(most: int, row_bytes: int) -> int:
    """Return how many observations of a size are kept."""
    return min(most, max(MIN_PLAYED, BYTES // max(1, row_bytes)))


def played_observations(source: Bundle) -> list[Encoded]:
    """Return the observations that a bundle's training kept; none where it kept none.

    Raises:
        DataError: when the file is corrupt, or does not fit the spec.
    """
    if OBSERVATIONS_FILE not in source.manifest.files:
        return []
    path = source.file(OBSERVATIONS_FILE)
    arrays = open_npz(path, fix=REMEDY)
    for tensor in source.manifest.spec.inputs:
        _check(path, tensor, arrays.get(tensor.name))
    names = [tensor.name for tensor in source.manifest.spec.inputs]
    if len({len(arrays[name]) for name in names}) > 1:
        raise _broken(path, "its inputs have different numbers of rows")
    rows = [Encoded({name: arrays[name][row : row + 1] for name in names}) for row in range(len(arrays[names[0]]))]
    for row, begins in zip(rows, arrays.get(BEGINS, ()), strict=False):
        row.begins = bool(begins)
    return rows


def _check(path: Path, tensor: TensorSpec, array: Array | None) -> None:
    name = tensor.name
    if array is None:
        raise _broken(path, f"it has no '{name}'")
    if array.shape[1:] != tensor.shape[1:] or array.dtype != np.dtype(tensor.dtype) or not array.ndim:
        wanted = f"{tensor.dtype} (N, {', '.join(map(str, tensor.shape[1:]))})"
        raise _broken(path, f"'{name}' is {array.dtype} {array.shape}; wanted {wanted}")
    if array.dtype.kind == "f" and tensor.finite and not np.isfinite(array).all():
        raise _broken(path, f"'{name}' has values that are not finite")


def _broken(path: Path, why: str) -> DataError:
    return DataError(f"{path} does not fit the policy: {why}.", REMEDY)
