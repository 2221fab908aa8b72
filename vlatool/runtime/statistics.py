"""Normalisation statistics: read, checked for width, and turned into one multiply and one add."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import STATISTICS_OF, TensorSpec
from vlatool.errors import SpecError, suggest
from vlatool.files.json import read_json
from vlatool.files.printable import amount
from vlatool.runtime.assets import Assets, asset_path, read_asset

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Normaliser:
    """Maps physical values to normalised ones and back: ``normalised = (physical - offset) / scale``.

    ``mean_std``: offset = mean, scale = std. ``min_max``, ``quantiles`` and ``quantile10`` map [low, high] to [-1, 1]:
    offset = (low + high) / 2, scale = (high - low) / 2. With an epsilon, as LeRobot has it: a std is that much larger
    on the way in alone, and ranges are ``(physical - low) / scale - 1``, bit for bit as LeRobot computes them in
    float32; an element whose low and high are equal has the scale epsilon / 2.

    Args:
        offset: float32 (A,), in the unit of the tensor.
        scale: float32 (A,), in the unit of the tensor.
        inverse_scale: float32 (A,): scale on the way back, where it is another one.
        low: float32 (A,): what becomes -1, where that is computed from there.
    """

    offset: Array
    scale: Array
    inverse_scale: Array | None = None
    low: Array | None = None
    _rows: dict[tuple[int, ...], tuple[Array, Array, Array]] = field(default_factory=dict, repr=False, compare=False)

    def forward(self, physical: Array) -> Array:
        """Physical to normalised, float32, any shape (..., A)."""
        origin, scale, _ = self._rows.get(physical.shape) or self._spread(physical.shape)
        normalised = (physical - origin) / scale
        return normalised if self.low is None else normalised - np.float32(1)

    def forward_row(self, physical: list[float]) -> Array:
        """Physical to normalised for one short vector: A numbers to float32 (1, A), without numpy's arithmetic."""
        pairs = zip(physical, self._numbers, strict=True)
        row = np.array([[(value - origin) / scale for value, (origin, scale) in pairs]], np.float32)
        return row if self.low is None else row - np.float32(1)

    @property
    def _origin(self) -> Array:
        return self.offset if self.low is None else self.low

    @functools.cached_property
    def _numbers(self) -> list[tuple[float, float]]:
        return list(zip(self._origin.tolist(), self.scale.tolist(), strict=True))

    def inverse(self, normalised: Array) -> Array:
        """Normalised to physical, float32, any shape (..., A)."""
        origin, _, scale = self._rows.get(normalised.shape) or self._spread(normalised.shape)
        return (normalised if self.low is None else normalised + np.float32(1)) * scale + origin

    def _spread(self, shape: tuple[int, ...]) -> tuple[Array, Array, Array]:
        """Return origin, scale and inverse scale of the full shape, kept: it spares numpy the broadcasting.

        Right after an inference the processor's caches hold the network, and broadcasting then takes 20 us longer
        (``vlatool benchmark overhead``).
        """
        origin, scale = np.broadcast_to(self._origin, shape).copy(), np.broadcast_to(self.scale, shape).copy()
        other = self.inverse_scale
        operands = origin, scale, scale if other is None else np.broadcast_to(other, shape).copy()
        self._rows[shape] = operands
        return operands


def load_normaliser(tensor: TensorSpec, assets: Assets) -> Normaliser | None:
    """Return the normaliser of a tensor, or None when its spec says ``normalisation: none``.

    Raises:
        SpecError: when statistics are missing, of another width than the tensor, not finite, or without spread.
    """
    if tensor.normalisation == "none":
        return None
    first, second = STATISTICS_OF[tensor.normalisation]
    low = _row(tensor, assets, first)
    high = _row(tensor, assets, second)
    with np.errstate(over="ignore"):
        offset, scale = (low, high) if first == "mean" else ((low + high) / 2, (high - low) / 2)
    without = scale <= 0 if not tensor.epsilon else scale < 0
    if without.any():
        raise SpecError(
            f"The statistics of '{tensor.name}' have no spread in the elements {np.flatnonzero(without).tolist()}.",
            "give those elements a positive std (or a wider range); of a joint that never moved, write epsilon: 1e-8, "
            "as LeRobot has it",
        )
    if not np.isfinite([offset, scale]).all():
        raise SpecError(f"The statistics of '{tensor.name}' span more than float32 holds.", "repair the statistics")
    offset, scale, epsilon = offset.astype(np.float32), scale.astype(np.float32), np.float32(tensor.epsilon)
    if not epsilon:
        return Normaliser(offset, scale)
    if first == "mean":
        return Normaliser(offset, scale + epsilon, inverse_scale=scale)
    return Normaliser(offset, np.where(scale == 0, epsilon / 2, scale).astype(np.float32), low=low)


def _row(tensor: TensorSpec, assets: Assets, key: str) -> Array:
    file, _, entry = tensor.statistics.partition("#")
    path = asset_path(assets, file)
    fix = "normalisation is never skipped in silence: put the training statistics into the policy's folder"
    try:
        content = read_asset(assets, file, "statistics_bytes")
    except OSError as error:
        raise SpecError(f"The statistics of '{tensor.name}' are missing: {path} ({error.strerror}).", fix) from error
    table = read_json(content, f"The file {path} with the statistics of '{tensor.name}'", SpecError, fix)
    if not isinstance(table, dict) or entry not in table:
        known = table if isinstance(table, dict) else ()
        raise SpecError(f"{path} has no statistics '{entry}' for '{tensor.name}'; {suggest(entry, known)}.", fix)
    if not isinstance(table[entry], dict) or key not in table[entry]:
        raise SpecError(f"The statistics '{entry}' in {path} lack '{key}', which {tensor.normalisation} needs.", fix)
    return _checked(table[entry][key], tensor, f"'{key}' of '{entry}' in {path}")


def _checked(values: object, tensor: TensorSpec, where: str) -> Array:
    try:
        if not _numbers(values):
            raise ValueError
        with np.errstate(all="ignore"):
            row = np.asarray(values, np.float32)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise SpecError(
            f"{where} is not a list of numbers.", "store a list of numbers, one for each element"
        ) from error
    if row.shape != (tensor.width,):
        raise SpecError(
            f"{where} has the shape {list(row.shape)}; '{tensor.name}' has {amount(tensor.width, 'element')}.",
            f"store {amount(tensor.width, 'number')}, one for each element",
        )
    if not np.all(np.isfinite(row)):
        raise SpecError(
            f"{where} has values that are not finite.",
            "leave NaN and infinity out when the statistics are computed (np.nanmean)",
        )
    return row


def _numbers(values: object) -> bool:
    """Return whether a value may be numbers or lists of them: text and truth values would become numbers, too."""
    inner = values if isinstance(values, list) else [values]
    return not any(isinstance(item, str | bool | dict) for item in inner)
