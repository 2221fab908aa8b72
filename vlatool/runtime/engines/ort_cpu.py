"""ONNX Runtime on the CPU."""

from __future__ import annotations

import contextlib
import os
import platform
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError, require
from vlatool.machine.engine_calls import REMEDY
from vlatool.machine.host import VNNI
from vlatool.runtime import arithmetic
from vlatool.runtime.contract import Port, port
from vlatool.runtime.engine import Engine, Int8Layout, Node, Profiled, Stages
from vlatool.runtime.engines._ort_profile import OrtProfiled, precision
from vlatool.runtime.stored_types import has_float8
from vlatool.runtime.weight_pairs import weights_fit

PROVIDER = "CPUExecutionProvider"
CUT_OFF_REWRITES = ["ReluQuantRewrite", "ClipQuantRewrite"]
SMALL = 256 * 1024
"""Bytes of all inputs and outputs up to which a run goes through buffers that are bound once."""
NUMPY_OF: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(float16)": np.dtype(np.float16),
    "tensor(double)": np.dtype(np.float64),
    "tensor(bool)": np.dtype(np.bool_),
    **{f"tensor({sign}int{bits})": np.dtype(f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)},
}
Array = NDArray[Any]
IGNORED_PROVIDERS = ("AzureExecutionProvider",)
"""ONNX Runtime lists it beside the processor in every build; it runs nothing on this machine."""
X86 = ("x86_64", "AMD64")
SIGNED_PRODUCT = "int8 x int8 on x86: ONNX Runtime's fast kernel takes uint8 x int8 (activations: uint8)"
INT8_VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "": {}, "_mse": {"method": "mse"}, "_attention": {"attention": True}, "_elementwise": {"elementwise": True},
}  # fmt: skip
"""Ending of a plan's name -> options of static int8 that a search begins with, and combines."""


class OrtCpuSession(Engine):
    """One ONNX file open in ONNX Runtime on the CPU, with fallback to other providers off.

    Args:
        path: The ONNX file; external data is found beside it.
        threads: Intra-op threads; the cores that this process may use when None.
        compute: ``float32`` or empty.
        opened: What is opened instead of ``path``: the content of the file, or another name of it.

    Raises:
        GraphError: when ONNX Runtime refuses the file, opened it on another provider, or is to compute in another
            dtype: it has no other one.
        MissingExtra: when onnxruntime is not installed.
    """

    title = "ONNX Runtime"
    package = "onnxruntime"
    extra = "ort"
    substitutes = ("onnxruntime-gpu", "onnxruntime-openvino")
    searched = True
    layouts: ClassVar[Mapping[str, Int8Layout]] = {"ort": Int8Layout(integer=True)}
    int8: ClassVar[Mapping[str, Any]] = {}
    remedy = "quantize again with --reduce-range, or with --activations int8"
    optimized: ClassVar[bool] = True
    """Whether ONNX Runtime may rewrite the graph."""

    def __init__(
        self, path: Path, threads: int | None = None, compute: str = "", opened: Path | bytes | None = None
    ) -> None:
        ort = require("onnxruntime", "ort")
        if compute not in ("", "float32"):
            raise GraphError(f"ONNX Runtime on the CPU does not compute in {compute}.", "use the engine openvino")
        try:
            self._session = self._open(ort, path if opened is None else opened, threads)
        except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
            raise GraphError(
                f"ONNX Runtime {ort.__version__} refuses {path}: {_first_line(error)}",
                REMEDY.format(package="onnxruntime"),
            ) from error
        self._session.disable_fallback()
        self.providers = list(self._session.get_providers())
        if self.providers != [PROVIDER]:
            raise GraphError(
                f"{path} was opened on {', '.join(self.providers)}; wanted {PROVIDER}.",
                "install onnxruntime alone: another package of it (onnxruntime-gpu) may be in its place",
            )
        self.path = path
        self.deadline: float | None = None
        self._run = self._session.run
        self.outputs = [node.name for node in self._session.get_outputs()]
        self.takes = {node.name: _port(node) for node in self._session.get_inputs()}
        self.gives = {node.name: _port(node) for node in self._session.get_outputs()}
        self._bound = _BoundBuffers.of(self._session, ort)
        self.bound = self._bound is not None

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array.

        Raises:
            GraphError: when ONNX Runtime fails on these inputs.
            TimeoutError: when ``deadline`` (seconds of ``time.monotonic``; none when None) passes.
        """
        try:
            if self.deadline is not None:
                return self._run_until(self.deadline, feeds)
            if self._bound is not None and self._bound.takes(feeds):
                return self._bound.run()
            return dict(zip(self.outputs, self._run(self.outputs, feeds), strict=True))
        except TimeoutError:
            raise
        except Exception as error:
            raise GraphError(
                f"ONNX Runtime failed in {self.path.name}: {_first_line(error)}", REMEDY.format(package="onnxruntime")
            ) from error

    def _run_until(self, deadline: float, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run, and let another thread tell ONNX Runtime to stop before its next node at the deadline."""
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError
        options = require("onnxruntime", "ort").RunOptions()
        options.log_severity_level = 4
        timer = threading.Timer(left, setattr, (options, "terminate", True))
        timer.daemon = True
        timer.start()
        try:
            if self._bound is not None and self._bound.takes(feeds):
                return self._bound.run(options)
            return dict(zip(self.outputs, self._run(self.outputs, feeds, options), strict=True))
        except Exception:
            if options.terminate:
                raise TimeoutError from None
            raise
        finally:
            timer.cancel()

    @classmethod
    def _open(cls, ort: Any, model: Path | bytes, threads: int | None) -> Any:
        """Open a session, with other options where the first break the graph; the first error is reported."""
        first, *others = cls._option_sets(ort, model, threads)
        try:
            return open_session(ort, model, first)
        except Exception:
            for options in others:
                with contextlib.suppress(Exception):
                    return open_session(ort, model, options)
            raise

    @staticmethod
    def _option_sets(ort: Any, model: Path | bytes, threads: int | None) -> list[Any]:
        """Return the options to try, one after the other.

        Exact products of uint8 activations refuse a graph with int8 ones, which are exact as long as they stay int8.
        Weights that cannot saturate need no such option, which would make them slower. And ONNX Runtime (1.31) takes
        float8 pairs around a MatMul for int8 ones and writes an integer product that has no such type. Where exact
        products would end the process, pairs are computed in float, which is exact, too.
        """
        entries: list[tuple[str, str] | None] = [None]
        if arithmetic.ort_product(ort) < arithmetic.WANTED and not is_true_of(weights_fit, model):
            breaks = is_true_of(arithmetic.breaks_precise, ort, model)
            entries = [] if breaks else [arithmetic.PRECISE, arithmetic.SIGNED]
        option_sets = []
        for entry in (*entries, arithmetic.UNFUSED):
            option_sets.append(session_options(ort, threads))
            if entry is not None:
                option_sets[-1].add_session_config_entry(*entry)
        return option_sets

    @staticmethod
    def arithmetic() -> str:
        """Return whether integer products are exact on this machine, or saturate.

        Raises:
            MissingExtra: when onnxruntime is not installed.
        """
        return arithmetic.ort_exactness(require("onnxruntime", "ort"))

    @classmethod
    def execution_providers(cls) -> list[str]:
        """Return the execution providers of the installed library, without those that run nothing on this machine.

        Raises:
            MissingExtra: when onnxruntime cannot be imported.
        """
        return [str(name) for name in cls.library().get_available_providers() if name not in IGNORED_PROVIDERS]

    @classmethod
    def variants(cls, has: Callable[..., bool], calibrated: bool) -> dict[str, Stages]:
        """Return int8 at run time, and with ranges from a recording: plain, by their error, attention too.

        Where int8 products saturate, weights are such that none does; all 8 bits, which take an exact mode, are one
        more plan.
        """
        saturates = has("avx2") and not has(*VNNI)
        weights = {"reduce_range": True} if saturates else {}
        plans: dict[str, Stages] = {"dynamic_int8": ({"quantize.dynamic_int8": dict(weights)},)}
        for name, options in INT8_VARIANTS.items() if calibrated else ():
            plans[f"static_int8{name}"] = ({"quantize.static_int8": {**weights, **options}},)
        if calibrated and saturates:
            plans["static_int8_all_bits"] = ({"quantize.static_int8": {"reduce_range": False}},)
        return plans

    @classmethod
    def profiled(cls, path: Path, threads: int, compute: str, scratch: Path) -> Profiled:
        """Open a graph with ONNX Runtime's trace of every node on.

        Raises:
            GraphError: when ONNX Runtime refuses it.
        """
        ort = cls.library()
        return OrtProfiled(ort, path, session_options(ort, threads), scratch, left_out(path))

    @classmethod
    def node_precision(cls, node: Node) -> str:
        """Return what a node computes in, by its kind and the dtype of its first input."""
        return precision(node)

    @classmethod
    def slow(cls, node: Node, computed: str, product: bool, zero_points: int) -> str:
        """Name products of two signed operands, for which x86 has no fast instruction before AVX-VNNI-INT8."""
        _, kind, dtypes = node
        signed = kind.startswith(("MatMulInteger", "QLinearMatMul", "QGemm")) and dtypes.startswith("int8")
        return SIGNED_PRODUCT if signed and platform.machine() in X86 else ""


class _BoundBuffers:
    """Buffers that are bound to the inputs and outputs of a small graph once, for all runs.

    ``run()`` of ONNX Runtime wraps every array again; writing into bound buffers instead takes some 20 us less right
    after an inference, when the processor's caches hold the network (``vlatool benchmark overhead``). Large tensors
    would pay more for the copy than that.
    """

    def __init__(self, session: Any, ort: Any, inputs: dict[str, Array], outputs: dict[str, Array]) -> None:
        self._inputs = [(name, buffer, buffer.shape, buffer.dtype) for name, buffer in inputs.items()]
        self._outputs = list(outputs.items())
        self._binding = binding = session.io_binding()
        shared = ort.OrtValue.ortvalue_from_numpy
        for name, buffer in inputs.items():
            binding.bind_ortvalue_input(name, shared(buffer))
        for name, buffer in outputs.items():
            binding.bind_ortvalue_output(name, shared(buffer))
        self._start, self._bindings = session.run_with_iobinding, binding
        if hasattr(session, "_sess") and hasattr(binding, "_iobinding"):  # past checks that concern other providers
            self._start, self._bindings = session._sess.run_with_iobinding, binding._iobinding

    @classmethod
    def of(cls, session: Any, ort: Any) -> _BoundBuffers | None:
        """Return buffers for a session, or None when a shape is dynamic, a type is not numpy's, or they are large."""
        inputs = {node.name: _buffer(node) for node in session.get_inputs()}
        outputs = {node.name: _buffer(node) if node.shape else None for node in session.get_outputs()}  # see _port
        small = {name: buffer for name, buffer in inputs.items() if buffer is not None}
        results = {name: buffer for name, buffer in outputs.items() if buffer is not None}
        total = sum(buffer.nbytes for buffer in (*small.values(), *results.values()))
        if len(small) < len(inputs) or len(results) < len(outputs) or total > SMALL:
            return None
        return cls(session, ort, small, results)

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


def _port(node: Any) -> Port:
    dtype = NUMPY_OF.get(str(node.type))
    name = str(node.type) if dtype is None else dtype.name
    return port(node.shape, name) if node.shape else Port(None, name)  # a scalar looks like an unknown number of axes


def _buffer(node: Any) -> Array | None:
    """Return an array of zeros like an input or output, or None when its shape or type is not fixed or not numpy's."""
    dtype = NUMPY_OF.get(str(node.type))
    if dtype is None or not all(isinstance(size, int) for size in node.shape):
        return None
    if 0 in node.shape or int(np.prod(node.shape)) * dtype.itemsize > SMALL:
        return None
    return np.zeros(node.shape, dtype)


def session_options(ort: Any, threads: int | None) -> Any:
    """Return what every session of ONNX Runtime is opened with; the cores that this process may use when None."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
    options.inter_op_num_threads = 1
    return options


def left_out(model: Path | bytes) -> list[str]:
    """Return the rewritings of ONNX Runtime that would make a graph compute something else than it says.

    They drop a Relu or Clip before a QuantizeLinear whose zero point is the smallest number of its type, since rounding
    to uint8 cuts off what is negative, and (seen in 1.31) take every float8 for such a type: negative values come
    through.
    """
    return CUT_OFF_REWRITES if is_true_of(has_float8, model) else []


def is_true_of(question: Callable[..., bool], *about: Any) -> bool:
    """Return what a graph is asked; a file that is none is refused when it is opened."""
    with contextlib.suppress(GraphError, OSError):
        return question(*about)
    return False


def open_session(ort: Any, model: Path | bytes, options: Any) -> Any:
    """Open a graph on the CPU alone, without what would make it another one."""
    content = model if isinstance(model, bytes) else str(model)
    optimizers = {"disabled_optimizers": left_out(model)}
    session = ort.InferenceSession(content, options, providers=[PROVIDER], enable_fallback=0, **optimizers)
    if getattr(session, "_model_bytes", None):
        session._model_bytes = b""  # Python's wrapper would keep the whole content for a fallback, which is off
    return session


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:300]
