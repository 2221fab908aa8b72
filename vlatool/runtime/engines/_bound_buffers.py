"""Buffers that the inputs and outputs of an ONNX Runtime session are bound to once, on the host or on a device."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.runtime.contract import Port, port

HOST = "cpu"
"""Device type of the memory that NumPy's arrays are in."""
MAX_BOUND_BYTES = 256 * 1024
"""Bytes of all inputs and outputs up to which a run goes through buffers that are bound once."""
NUMPY_OF: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(float16)": np.dtype(np.float16),
    "tensor(double)": np.dtype(np.float64),
    "tensor(bool)": np.dtype(np.bool_),
    **{f"tensor({sign}int{bits})": np.dtype(f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
Array = NDArray[Any]


class BoundBuffers:
    """Buffers that are bound to the inputs and outputs of a small graph once, for all runs.

    ``run()`` of ONNX Runtime wraps every array again; writing into bound buffers instead takes some 20 us less right
    after an inference, when the processor's caches hold the network (``vlatool benchmark overhead``). Large tensors
    would pay more for the copy than that.
    """

    def __init__(
        self, session: Any, ort: Any, inputs: dict[str, Array], outputs: dict[str, Array], memory: str = HOST
    ) -> None:
        self._inputs = [(name, buffer, buffer.shape, buffer.dtype) for name, buffer in inputs.items()]
        self._outputs = list(outputs.items())
        self._binding = binding = session.io_binding()
        tensor = ort.OrtValue.ortvalue_from_numpy  # shares the memory of an array on the host, copies it elsewhere
        self._fed = [(tensor(buffer, memory, 0), buffer) for buffer in inputs.values()]
        self._results = [(name, tensor(buffer, memory, 0)) for name, buffer in outputs.items()]
        for name, (value, _) in zip(inputs, self._fed, strict=True):
            binding.bind_ortvalue_input(name, value)
        for name, value in self._results:
            binding.bind_ortvalue_output(name, value)
        self._start, self._bindings = session.run_with_iobinding, binding
        if hasattr(session, "_sess") and hasattr(binding, "_iobinding"):  # past checks that concern other providers
            self._start, self._bindings = session._sess.run_with_iobinding, binding._iobinding

    @classmethod
    def of(cls, session: Any, ort: Any, memory: str) -> BoundBuffers | None:
        """Return buffers for a session, or None when a shape is dynamic, a type is not numpy's, or they are large."""
        inputs = {node.name: _buffer(node) for node in session.get_inputs()}
        outputs = {node.name: _buffer(node) if node.shape else None for node in session.get_outputs()}  # see _port
        small = {name: buffer for name, buffer in inputs.items() if buffer is not None}
        results = {name: buffer for name, buffer in outputs.items() if buffer is not None}
        total = sum(buffer.nbytes for buffer in (*small.values(), *results.values()))
        if len(small) < len(inputs) or len(results) < len(outputs) or total > MAX_BOUND_BYTES:
            return None
        return (cls if memory == HOST else DeviceBuffers)(session, ort, small, results, memory)

    def takes(self, feeds: Mapping[str, Any]) -> bool:
        """Copy the feeds into the buffers; False when one does not fit, so that ONNX Runtime names the mistake."""
        for name, buffer, shape, dtype in self._inputs:
            value = feeds.get(name)
            if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype != dtype:
                return False
            buffer[...] = value
        return len(feeds) == len(self._inputs)

    def run(self, options: Any = None) -> dict[str, Array]:
        """Run on what the buffers hold and return copies of the outputs."""
        self._start(self._bindings, options)
        return {name: buffer.copy() for name, buffer in self._outputs}


class DeviceBuffers(BoundBuffers):
    """The same in the memory of a device: what is fed is copied there before a run, and results back after it."""

    def run(self, options: Any = None) -> dict[str, Array]:
        """Run on what the buffers hold and return copies of the outputs."""
        for value, buffer in self._fed:
            value.update_inplace(buffer)
        self._start(self._bindings, options)
        return {name: np.array(value.numpy()) for name, value in self._results}


def port_of(node: Any) -> Port:
    dtype = NUMPY_OF.get(str(node.type))
    name = str(node.type) if dtype is None else dtype.name
    return port(node.shape, name) if node.shape else Port(None, name)  # a scalar looks like an unknown number of axes


def _buffer(node: Any) -> Array | None:
    """Return an array of zeros like an input or output, or None when its shape or type is not fixed or not numpy's."""
    dtype = NUMPY_OF.get(str(node.type))
    if dtype is None or not all(isinstance(size, int) for size in node.shape):
        return None
    if 0 in node.shape or int(np.prod(node.shape)) * dtype.itemsize > MAX_BOUND_BYTES:
        return None
    return np.zeros(node.shape, dtype)
