"""What the graphs give -> the action as the controller takes it: the counterpart of the observation's encoder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime.assets import Assets
from vlatool.runtime.contract import not_finite
from vlatool.runtime.observation import all_finite
from vlatool.runtime.statistics import Normaliser, load_normaliser

Array = NDArray[Any]


class Decoder:
    """The action output -> a chunk in physical units, or indices of discrete actions."""

    def __init__(self, spec: PolicySpec, assets: Assets) -> None:
        self.tensor: TensorSpec = spec.action
        self.normaliser: Normaliser | None = load_normaliser(spec.action, assets)
        self._floating = np.dtype(spec.action.dtype).kind == "f"
        self._half = spec.action.dtype == "float16"

    def __call__(self, raw: Array) -> tuple[Array, tuple[str, ...]]:
        """Return the chunk and its labels; raises GraphError when a value is not finite."""
        tensor = self.tensor
        physical = raw.astype(np.float32) if self._half else raw
        if self.normaliser is not None:
            try:
                physical = self.normaliser.inverse(physical)
            except (RuntimeWarning, FloatingPointError):  # an overflow, where the caller lets numpy raise
                raise not_finite(tensor.name) from None
        if self._floating and not all_finite(physical):
            raise not_finite(tensor.name)
        if tensor.kind == "discrete":
            chunk = raw.argmax(-1).reshape(-1)
            return chunk, tuple([tensor.labels[index] for index in chunk.tolist()])
        return physical.reshape(-1, physical.shape[-1]), tensor.labels
