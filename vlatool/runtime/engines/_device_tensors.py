"""Tensors that stay where an ONNX Runtime session computed them, until another session or the host takes them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.engines._bound_buffers import HOST

Array = NDArray[Any]


class DeviceTensor:
    """An output in the memory of its session; NumPy sees a copy of it."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """Copy the tensor to the host."""
        return np.asarray(self.value.numpy(), dtype)


def run_bound(
    session: Any,
    feeds: Mapping[str, Any],
    outputs: Mapping[str, bool],
    memory: str,
    options: Any = None,
) -> dict[str, Any]:
    """Run a session; nothing is copied of feeds that are ``DeviceTensor``, and of outputs that stay.

    Args:
        feeds: input name -> array or ``DeviceTensor``.
        outputs: output name -> whether it stays in the session's memory.
        memory: device type of that memory.
        options: ``RunOptions``.

    Returns:
        Output name -> array, or ``DeviceTensor`` where it stays; later runs do not change either.
    """
    binding = session.io_binding()
    left = {name: value.value for name, value in feeds.items() if isinstance(value, DeviceTensor)}
    arrays = {name: np.asarray(value, order="C") for name, value in feeds.items() if name not in left}
    for name, value in left.items():
        binding.bind_ortvalue_input(name, value)
    for name, array in arrays.items():  # whose memory is bound until the run ends
        binding.bind_cpu_input(name, array)
    for name, stays in outputs.items():
        binding.bind_output(name, memory if stays else HOST)
    session.run_with_iobinding(binding, options)
    results = zip(outputs.items(), binding.get_outputs(), strict=True)
    return {name: DeviceTensor(value) if stays else value.numpy() for (name, stays), value in results}


def on_host(feeds: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return feeds with those of these names copied to the host, where they are elsewhere."""
    return {name: np.asarray(value) if name in names else value for name, value in feeds.items()}
