"""What the graphs give -> the action as the controller takes it: the counterpart of the observation's encoder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime.assets import Assets
from vlatool.runtime.contract import not_finite
from vlatool.runtime.converter import action_converter
from vlatool.runtime.observation import all_finite
from vlatool.runtime.statistics import Normaliser

Array = NDArray[Any]


class Decoder:
    """The action output -> a chunk in physical units, or indices of discrete actions."""

    def __init__(self, spec: PolicySpec, assets: Assets) -> None:
        self.tensor: TensorSpec = spec.action
        self._converter = action_converter(spec, assets)
        self._converts = bool(spec.action.convert)
        self.normaliser: Normaliser | None = self._converter.normaliser
        self._floating = np.dtype(spec.action.dtype).kind == "f"
        self._half = spec.action.dtype == "float16"

    def __call__(self, raw: Array, state: Array | None = None) -> tuple[Array, tuple[str, ...]]:
        """Return the chunk and its labels.

        Args:
            raw: what the graph gives.
            state: (S,) what the action is relative to, where its spec says so.

        Raises:
            GraphError: when a value is not finite.
        """
        tensor = self.tensor
        physical = raw.astype(np.float32) if self._half else raw
        if self._converts and not all_finite(raw):  # a threshold or a bound would make an action of it
            raise not_finite(tensor.name)
        try:
            if self._converts:
                physical = self._converter.to_robot(physical.reshape(-1, physical.shape[-1]), state)
            elif self.normaliser is not None:
                physical = self.normaliser.inverse(physical)
        except (RuntimeWarning, FloatingPointError):  # an overflow, where the caller lets numpy raise
            raise not_finite(tensor.name) from None
        if self._floating and not all_finite(physical):
            raise not_finite(tensor.name)
        if tensor.kind == "discrete":
            chunk = raw.argmax(-1).reshape(-1)
            return chunk, tuple([tensor.labels[index] for index in chunk.tolist()])
        return physical.reshape(-1, physical.shape[-1]), tensor.labels

    def unnormalise(self, raw: Array) -> Array:
        """Return the chunk (T, A) with its statistics alone: what rounding moves a little, it moves a little here, too.

        A gripper that is open or closed, an angle that jumps by a turn: conversions are not continuous.
        """
        physical = raw.astype(np.float32) if self._half else raw
        physical = physical if self.normaliser is None else self.normaliser.inverse(physical)
        return physical.reshape(-1, physical.shape[-1])
