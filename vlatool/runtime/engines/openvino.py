"""OpenVINO on the CPU."""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import GraphError, fix_for, require, suggest
from vlatool.machine.engine_calls import REMEDY
from vlatool.machine.host import MAX_CPU_ISA, VNNI, onednn_max_cpu_isa
from vlatool.runtime import arithmetic
from vlatool.runtime.contract import Port
from vlatool.runtime.engine import INT8, Engine, Int8Layout, Node, NodeRun, Profiled, Stages
from vlatool.runtime.engines._openvino_core import openvino_core
from vlatool.runtime.engines._openvino_profile import OpenvinoProfiled, node_runs, precision, products
from vlatool.runtime.engines._sequences import joins_a_sequence
from vlatool.runtime.stored_types import has_float8

if TYPE_CHECKING:
    from vlatool.machine.target import Target

FEEDS = "give every input of the graph, of the shape and type that the graph declares"
DEVICE = "CPU"
AMX, BF16 = ("amx_tile", "amx_int8"), ("amx_bf16", "avx512_bf16")
INT8_VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "int8": {}, "int8_mse": {"method": "mse"}, "int8_attention": {"attention": True},
    "int8_elementwise": {"elementwise": True},
}  # fmt: skip
"""Name -> options of the int8 plans that a search begins with, and combines."""
GRACE_MS = 1000
"""How long a run that is cancelled may take to end."""
HINTS = {"": "f32", "float32": "f32", "bfloat16": "bf16"}
"""What OpenVINO is asked to compute in: left alone it silently takes bfloat16 where the processor has it."""
PLAIN = {"SNIPPETS_MODE": "DISABLE"}
"""One kernel for each operator, none generated for several."""
NO_KERNEL = ("bad combination", "inner product")
"""What OpenVINO says of a processor without the instructions that a graph needs."""
PARTIAL_BLOCK = "cannot be divided by block_size"
"""What OpenVINO says of a layer whose inputs are not a whole number of blocks."""


class OpenvinoSession(Engine):
    """One ONNX file compiled by OpenVINO for the CPU.

    Inputs and outputs have the names that they have in the file: where compiling removes a Reshape or Identity beside
    one, OpenVINO (2026.4) gives the port the names of both values, and any of them when asked for one.

    Args:
        path: The ONNX file; external data is found beside it.
        threads: Threads; the cores that this process may use when None.
        compute: Dtype of what is not quantized: ``float32`` (also when empty) or ``bfloat16``.
        opened: What is opened instead of ``path``: the content of the file, or another name of it.
        traced: Whether ``node_runs`` is to count the products that OpenVINO merges with others.

    Raises:
        GraphError: when OpenVINO refuses the file or computes in another dtype than asked for.
        MissingExtra: when openvino is not installed.
    """

    device: ClassVar[str] = DEVICE
    """OpenVINO's name of what computes."""
    hints: ClassVar[Mapping[str, str]] = HINTS
    """What OpenVINO is asked to compute in, for each dtype in ``computes``; for none named when empty."""
    title = "OpenVINO"
    package = "openvino"
    extra = "openvino"
    traces = True
    advice = "fastest on Intel"
    computes: ClassVar[tuple[str, ...]] = ("float32", "bfloat16")
    confined = True
    layouts: ClassVar[Mapping[str, Int8Layout]] = {
        "openvino": Int8Layout(fuses_convolutions=False, symmetric=True, convolutions=True, crashes=True)
    }
    int8: ClassVar[Mapping[str, Any]] = {"layout": "openvino"}
    remedy = "quantize again with --reduce-range, or with --layout ort for ONNX Runtime, whose products are exact"

    def __init__(
        self,
        path: Path,
        threads: int | None = None,
        compute: str = "",
        opened: Path | bytes | None = None,
        traced: bool = False,
    ) -> None:
        openvino = require("openvino", "openvino")
        self._check_device(openvino_core())
        settings = self.settings(threads, compute)
        content = path if opened is None else opened
        try:
            core = openvino_core()
            model = core.read_model(io.BytesIO(content) if isinstance(content, bytes) else str(content))
            self._check_model(model)
            self._products = products(model) if traced else {}
            declared = [[port.get_any_name() for port in ports] for ports in (model.inputs, model.outputs)]
            self._compiled = self._compile(core, model, settings)
            self._request = self._compiled.create_infer_request()
        except GraphError:
            raise
        except Exception as error:  # the seam: every exception type of OpenVINO becomes ours
            words = f"OpenVINO {self.version()} refuses {path}: {_last_line(error)}"
            raise GraphError(
                words, _remedy(error) or _without_float8(content) or REMEDY.format(package="openvino")
            ) from error
        self.path = path
        self._check_execution()
        self.precision = str(self._compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name())
        if self.precision != self.hints[compute]:
            raise GraphError(
                f"OpenVINO computes {path} in {self.precision} on this {self.device}; wanted {self.hints[compute]}.",
                "make the bundle for this processor: vlatool optimize",
            )
        ports = self._compiled.inputs, self._compiled.outputs
        self._inputs, outputs = (
            dict(zip(names, side, strict=True)) for names, side in zip(declared, ports, strict=True)
        )
        self.outputs = list(outputs)
        self._outputs = [(name, number) for number, name in enumerate(outputs)]
        self.takes = {name: _port(port) for name, port in self._inputs.items()}
        self.gives = {name: _port(port) for name, port in outputs.items()}
        self.deadline: float | None = None
        self._stoppable = self._stopped = False
        self._buffers = self._bound(openvino)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array.

        Raises:
            GraphError: when an input is missing or of another dtype, or OpenVINO fails on these inputs.
            TimeoutError: when ``deadline`` (seconds of ``time.monotonic``; none when None) passes, or after ``stop``.
        """
        try:
            if self.deadline is not None:
                self._run_until(self.deadline, feeds)
            elif self._stoppable:
                self._run_stoppable(feeds)
            elif self._buffers and self._fill(feeds):
                self._request.infer()
            else:
                self._check(feeds)
                self._request.infer(feeds)
            return {name: np.array(self._request.get_output_tensor(number).data) for name, number in self._outputs}
        except (GraphError, TimeoutError):
            raise
        except Exception as error:
            raise GraphError(
                f"OpenVINO failed in {self.path.name}: {_last_line(error)}", REMEDY.format(package="openvino")
            ) from error

    def _run_until(self, deadline: float, feeds: Mapping[str, Any]) -> None:
        """Run, but do not wait beyond the deadline.

        OpenVINO (2026.2) stops between two nodes of a graph only, so that a loop inside of one goes on: it cannot be
        ended but with the process, and would be waited for when its request is freed, so that is kept.
        """
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._start(feeds)
        if self._request.wait_for(max(1, int(left * 1e3))):
            self._request.wait()
            return
        self._request.cancel()
        if not self._request.wait_for(GRACE_MS):
            for kept in (self._request, self._compiled):
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
            raise TimeoutError(", but OpenVINO goes on with it until this process ends")
        raise TimeoutError

    def _run_stoppable(self, feeds: Mapping[str, Any]) -> None:
        """Run as a request that another thread can cancel, which ``infer`` is not (2026.4: it ignores ``cancel``)."""
        if self._stopped:
            raise TimeoutError
        self._start(feeds)
        if self._stopped:  # between the two lines above
            self._request.cancel()
        try:
            self._request.wait()
        except RuntimeError:
            if self._stopped:
                raise TimeoutError from None
            raise

    def _start(self, feeds: Mapping[str, Any]) -> None:
        if self._buffers and self._fill(feeds):
            self._request.start_async()
        else:
            self._check(feeds)
            self._request.start_async(feeds)

    def node_runs(self) -> list[NodeRun]:
        """Return the nodes of the compiled model, each as it runs once, with the kernels that OpenVINO chose."""
        return node_runs(self._compiled, self._products)

    def stop(self) -> None:
        """End the run in progress between two nodes; it and later ones raise TimeoutError until ``resume``.

        A loop within the graph goes on. Nothing happens before the first call of ``resume``.
        """
        self._stopped = self._stoppable
        if self._stopped:
            self._request.cancel()

    def resume(self) -> None:
        """Allow runs again, which ``stop`` can end from now on."""
        self._stoppable, self._stopped = True, False

    def _bound(self, openvino: Any) -> dict[str, NDArray[Any]]:
        """Set our own arrays as the request's inputs, once; none when a shape is dynamic or a type not numpy's.

        Python's ``infer(feeds)`` checks and wraps every array at every call.
        """
        ports = self._inputs.values()
        if any(port.partial_shape.is_dynamic or port.element_type.get_type_name() == "bf16" for port in ports):
            return {}
        buffers = {}
        for name, port in self._inputs.items():
            buffer = np.zeros(tuple(port.shape), port.element_type.to_dtype())
            self._request.set_tensor(port, openvino.Tensor(buffer, shared_memory=True))
            buffers[name] = buffer
        return buffers

    def _fill(self, feeds: Mapping[str, Any]) -> bool:
        """Copy the feeds into the request's inputs; False when one does not fit, so that OpenVINO names the mistake."""
        if len(feeds) != len(self._buffers):
            return False
        for name, buffer in self._buffers.items():
            value = feeds.get(name)
            if not isinstance(value, np.ndarray) or value.shape != buffer.shape or value.dtype != buffer.dtype:
                return False
            buffer[...] = value
        return True

    def _check(self, feeds: Mapping[str, Any]) -> None:
        """Refuse what OpenVINO takes: a missing input (an earlier run's is left there), another dtype (it casts)."""
        for name, port in self._inputs.items():
            dtype = np.dtype(port.element_type.to_dtype())
            value = feeds.get(name)
            if not isinstance(value, np.ndarray) or value.dtype != dtype:
                got = "missing" if value is None else str(getattr(value, "dtype", type(value).__name__))
                raise GraphError(
                    f"OpenVINO failed in {self.path.name}: the input '{name}' is {got}; wanted {dtype}.", FEEDS
                )
            actual, expected = Port(value.shape, str(dtype)), self.takes[name]
            if not actual.fits(expected):
                raise GraphError(
                    f"OpenVINO failed in {self.path.name}: '{name}' is {actual}; wanted {expected}.", FEEDS
                )

    @classmethod
    def targets(cls) -> tuple[str, ...]:
        """Return the device."""
        return (cls.device,)

    @classmethod
    def settings(cls, threads: int | None, compute: str) -> dict[str, Any]:
        """Return what a model is compiled with; raises GraphError when the device does not compute in that dtype."""
        return settings_for(threads, compute)

    @classmethod
    def _compile(cls, core: Any, model: Any, settings: dict[str, Any]) -> Any:
        return compile_for_cpu(core, model, settings)

    @classmethod
    def _check_device(cls, core: Any) -> None:
        """Refuse a device that OpenVINO does not find; raises MissingExtra."""

    def _check_model(self, model: Any) -> None:
        """Refuse a model that the device would compute otherwise than it says; raises GraphError."""

    def _check_execution(self) -> None:
        """Refuse a model that was compiled for another device than asked for; raises GraphError."""
        devices = [str(name) for name in self._compiled.get_property("EXECUTION_DEVICES")]
        if [name.partition(".")[0] for name in devices] != [self.device]:
            raise GraphError(
                f"OpenVINO compiled {self.path} for {', '.join(devices) or 'nothing'}; wanted {self.device}.",
                "see which devices OpenVINO finds: vlatool doctor",
            )

    @staticmethod
    def arithmetic() -> str:
        """Return whether integer products are exact on this machine, or saturate. Takes a fraction of a second.

        Raises:
            MissingExtra: when openvino is not installed.
        """
        require("openvino", "openvino")
        try:
            core = openvino_core()
            compiled = core.compile_model(core.read_model(io.BytesIO(arithmetic.model())), DEVICE, settings_for(1, ""))
            return arithmetic.exactness(float(compiled(arithmetic.operand())[0].min()))
        except Exception:  # the seam: older processors lack the kernels of any int8 product
            return arithmetic.UNKNOWN

    @classmethod
    def variants(cls, target: Target, calibrated: bool) -> dict[str, Stages]:
        """Return bfloat16 where the processor has it, and int8 with what is not quantized in that.

        With matrix units (AMX) products are written as convolutions, too, as ``quantize.int8.convolutions`` says; where
        int8 products saturate, weights are such that none does.
        """
        plans: dict[str, Stages] = {}
        forms: dict[str, dict[str, Any]] = (
            {"": {}, "_convolutions": {"convolutions": True}} if target.has(*AMX) else {"": {}}
        )
        bfloat16 = target.has(*BF16)
        for form, how in forms.items() if bfloat16 else ():
            plans[f"openvino_bf16{form}"] = ({"quantize.bfloat16": how},)
        rest: dict[str, Any] = {"compute": "bfloat16"} if bfloat16 else {}
        rest |= {"reduce_range": True} if target.has("avx2") and not target.has(*VNNI) else {}
        for name, options in INT8_VARIANTS.items() if calibrated else ():
            for form, how in forms.items() if name == "int8" else list(forms.items())[-1:]:
                stage = {"layout": "openvino", **rest, **how, **options}
                plans[f"openvino_{name}{form}"] = ({"quantize.static_int8": stage},)
        return plans

    @classmethod
    def open_profiled(cls, path: Path, threads: int, compute: str, scratch: Path) -> Profiled:
        """Open a graph with OpenVINO's counters of every node on; raises GraphError when OpenVINO refuses it."""
        settings = {**cls.settings(threads, compute), "PERF_COUNT": True}
        return OpenvinoProfiled(path, lambda core, model: cls._compile(core, model, settings))

    @classmethod
    def node_precision(cls, node: Node) -> str:
        """Return what a node computes in, by its kind and the ending of its kernel."""
        return precision(node)

    @classmethod
    def slow(cls, node: Node, computed: str, product: bool, zero_points: int) -> str:
        """Name reference kernels, and zero points that keep FullyConnected off its symmetric path."""
        _, kind, kernel = node
        if product and kernel.startswith("ref"):
            return f"runs as the reference kernel {kernel}"
        if zero_points and kind == "FullyConnected" and computed == INT8:
            return (
                f"activations with zero points ({zero_points} in the graph): not the symmetric path (activations: auto)"
            )
        return ""


def _remedy(error: Exception) -> str:
    """Return what to do where OpenVINO refuses such a graph, or has no kernel for this processor.

    The kernel may also be missing in what a variable confines it to.
    """
    if PARTIAL_BLOCK in str(error):
        return "OpenVINO only takes whole blocks: use the engine ort_cpu, or leave the narrower layers out (--exclude)"
    if not any(sign in str(error) for sign in NO_KERNEL):
        return ""
    lacks = "instructions that OpenVINO needs for it: quantize with --layout ort"
    if confined := onednn_max_cpu_isa():
        return f"{MAX_CPU_ISA} confines OpenVINO to {confined}, which lacks {lacks}, or unset it if no board is meant"
    return f"this processor lacks {lacks}"


def _without_float8(model: Path | bytes) -> str:
    """Return what to do where a graph in float8 is refused: OpenVINO takes some of them only."""
    with contextlib.suppress(GraphError, OSError):
        if has_float8(model):
            return "OpenVINO computes few graphs in float8: use the engine ort_cpu, or another precision"
    return ""


def compile_for_cpu(core: Any, model: Any, settings: dict[str, Any]) -> Any:
    """Compile a model for the CPU; where that fails or would crash, without kernels generated for several operators.

    OpenVINO (2026.4) takes Linear, Mish, Linear for a sequence that it can generate code for, and then has none for
    Mish. For what crashes see ``_sequences``.

    Raises:
        RuntimeError: what the first attempt raised, when the second fails too.
    """
    if joins_a_sequence(model):
        return core.compile_model(model, DEVICE, {**settings, **PLAIN})
    try:
        return core.compile_model(model, DEVICE, settings)
    except Exception as error:
        with contextlib.suppress(Exception):
            return core.compile_model(model, DEVICE, {**settings, **PLAIN})
        raise error


def settings_for(threads: int | None, compute: str) -> dict[str, Any]:
    """Return what a model is compiled with; raises GraphError when OpenVINO does not compute in that dtype."""
    if compute not in HINTS:
        raise GraphError(
            f"OpenVINO on the CPU does not compute in {compute}; {suggest(compute, filter(None, HINTS))}.",
            fix_for(compute, filter(None, HINTS)),
        )
    return {
        "INFERENCE_PRECISION_HINT": HINTS[compute],
        "INFERENCE_NUM_THREADS": threads or len(os.sched_getaffinity(0)),
        "NUM_STREAMS": 1,
        "PERFORMANCE_HINT": "LATENCY",
        "ENABLE_CPU_PINNING": False,
    }


def _port(port: Any) -> Port:
    shape = port.partial_shape
    if shape.rank.is_dynamic:
        return Port(None, _dtype(port))
    return Port(tuple(axis.get_length() if axis.is_static else None for axis in shape), _dtype(port))


def _dtype(port: Any) -> str:
    name = str(port.element_type.get_type_name())
    return name if name == "bf16" else str(np.dtype(port.element_type.to_dtype()).name)


def _last_line(error: Exception) -> str:
    """Return the last line that says why: OpenVINO ends some errors with a summary of which operators failed."""
    lines = [line.strip() for line in str(error).split("\nSummary:")[0].splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__)[:300]
