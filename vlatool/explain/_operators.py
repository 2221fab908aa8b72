"""Where the time of an inference goes: the engine's own profile, operator by operator."""

from __future__ import annotations

import json
import tempfile
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, require
from vlatool.machine.host import onednn_max_cpu_isa
from vlatool.machine.instruction_sets import ENGINE
from vlatool.runtime.engines.openvino import compiled, settings_for
from vlatool.runtime.engines.ort_cpu import left_out
from vlatool.runtime.policy import DEFAULT_ENGINE, Policy
from vlatool.runtime.program import Program

INT8, BFLOAT16, FLOAT32, MOVING, QUANTIZING = "int8", "bfloat16", "float32", "moving data", "quantize-dequantize"
GROUPS = (INT8, BFLOAT16, FLOAT32, MOVING, QUANTIZING)
MOVES = frozenset({
    *("Reshape", "Transpose", "Concat", "Split", "Slice", "Gather", "Unsqueeze", "Squeeze", "Expand", "Identity"),
    *("Cast", "Convert", "Reorder", "ReorderInput", "ReorderOutput", "Pad", "Tile", "Flatten", "Shape", "ShapeOf"),
    *("ScatterND", "ScatterElements", "GatherElements", "ConstantOfShape", "StridedSlice", "Broadcast", "Copy"),
    *("MemoryInput", "MemoryOutput", "Parameter", "Result", "Input", "Output"),
})  # fmt: skip
QUANTIZES = frozenset(("QuantizeLinear", "DequantizeLinear", "DynamicQuantizeLinear", "FakeQuantize"))
INTEGER = ("MatMulInteger", "QLinear", "QGemm", "ConvInteger", "DynamicQuantize", "QAttention", "QEmbed")
PRODUCTS = ("MatMul", "Gemm", "Conv", "FullyConnected", "Attention", "ScaledDot")
CONTAINERS = ("If", "Loop", "Scan")
"""Their time is that of the nodes inside, which have entries of their own."""
WARMUP = 3


@dataclass(frozen=True)
class Operator:
    """One node of a graph as the engine runs it.

    Args:
        graph: Name of the graph.
        name: Name that the engine gives the node, often that of the layer.
        kind: Operator type of the engine.
        precision: One of ``GROUPS``, or another dtype.
        kernel: What the engine says of its kernel (OpenVINO), or the dtypes of its inputs (ONNX Runtime).
        calls: Runs in one inference.
        ms: Time of all its runs in one inference, median over the inferences.
    """

    graph: str
    name: str
    kind: str
    precision: str
    kernel: str
    calls: int
    ms: float

    @property
    def product(self) -> bool:
        """Whether it is a matrix product or a convolution."""
        return any(word in self.kind for word in PRODUCTS) and self.precision not in (MOVING, QUANTIZING)


class _Profiled(Protocol):
    """A session that notes the time of its nodes."""

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array."""

    def times(self) -> list[dict[tuple[str, str, str], float]]:
        """Return for each run: (name, kind, kernel) -> microseconds."""


def profile(
    bundle: Bundle, observations: Sequence[Mapping[str, Any]], runs: int = 20, threads: int = 1, engine: str = ""
) -> list[Operator]:
    """Run a bundle with the engine's profiler on.

    Args:
        bundle: What is profiled.
        observations: Raw observations, taken in turn.
        runs: Inferences that count; three before them do not.
        threads: Intra-op threads.
        engine: The bundle's own when empty.

    Returns:
        Every operator that ran, the slowest first.

    Raises:
        GraphError: when the engine has no profiler here, or fails.
    """
    engine = engine or bundle.manifest.engine or DEFAULT_ENGINE
    opened = PROFILERS.get(engine)
    if opened is None:
        raise GraphError(f"The engine {engine} cannot be profiled; allowed: ort_cpu, openvino.")
    with tempfile.TemporaryDirectory(prefix="vlatool-") as scratch:
        sessions: dict[str, _Profiled] = {
            name: opened(bundle.file(graph.file), threads, graph.compute, Path(scratch) / name)
            for name, graph in bundle.manifest.graphs.items()
        }
        policy = Policy(bundle, Program(bundle.manifest.program, sessions, seed=0), engine)
        for index in range(WARMUP + runs):
            policy.infer(observations[index % len(observations)])
        turns: Counter[str] = Counter()
        for step in bundle.manifest.program:
            turns[step.graph] += step.repeat
        found = [each for name, session in sessions.items() for each in _operators(name, session, turns[name], engine)]
    return sorted(found, key=lambda each: -each.ms)


def reference_engine(bundle: Bundle) -> str:
    """Return the engine that float32 runs in when a bundle is compared with it; empty for float32's own.

    Where OpenVINO is confined to an instruction set, a ratio to ONNX Runtime, which cannot be, is one of two sets.
    """
    return ENGINE if bundle.manifest.engine == ENGINE and onednn_max_cpu_isa() else ""


def _operators(graph: str, session: _Profiled, turns: int, engine: str) -> Iterable[Operator]:
    """Yield the operators of a graph that runs ``turns`` times in one inference."""
    by_inference: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    calls: Counter[tuple[str, str, str]] = Counter()
    times = session.times()[WARMUP * turns :]
    for start in range(0, len(times), turns or 1):
        total: Counter[tuple[str, str, str]] = Counter()
        for run in times[start : start + turns]:
            for key, spent in run.items():
                total[key] += spent  # type: ignore[assignment]
                calls[key] += 1
        for key, spent in total.items():
            by_inference[key].append(spent)
    for key, spent_each in by_inference.items():
        name, kind, kernel = key
        count = round(calls[key] / len(spent_each))
        precision = _ort_precision(kind, kernel) if engine == "ort_cpu" else _openvino_precision(name, kind, kernel)
        yield Operator(graph, name, kind, precision, kernel, count, float(np.median(spent_each)) / 1e3)


class _OrtProfiled:
    """ONNX Runtime writes a trace file of every node of every run."""

    def __init__(self, path: Path, threads: int, _compute: str, scratch: Path) -> None:
        ort = require("onnxruntime", "ort")
        options = ort.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.enable_profiling = True
        options.profile_file_prefix = str(scratch)
        try:
            self._session = ort.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"], disabled_optimizers=left_out(path)
            )
        except Exception as error:  # the seam: every pybind exception type of ONNX Runtime becomes ours
            raise GraphError(f"ONNX Runtime cannot profile {path.name}: {str(error)[:200]}") from error
        self._outputs = [node.name for node in self._session.get_outputs()]

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        return dict(zip(self._outputs, self._session.run(self._outputs, feeds), strict=True))

    def times(self) -> list[dict[tuple[str, str, str], float]]:
        events = json.loads(Path(self._session.end_profiling()).read_text(encoding="utf-8"))
        starts = sorted(event["ts"] for event in events if event["name"] == "model_run")
        found: list[dict[tuple[str, str, str], float]] = [{} for _ in starts]
        for event in events:
            name, about = event["name"], event.get("args", {})
            if event["cat"] != "Node" or not name.endswith("_kernel_time") or about["op_name"] in CONTAINERS:
                continue
            dtypes = " ".join(next(iter(each)) for each in about.get("input_type_shape", ()) if each)
            key = (name.removesuffix("_kernel_time"), about["op_name"], dtypes)
            run = found[bisect_right(starts, event["ts"]) - 1]
            run[key] = run.get(key, 0.0) + event["dur"]
        return found


def _ort_precision(kind: str, dtypes: str) -> str:
    if kind in QUANTIZES:
        return QUANTIZING
    if kind in MOVES:
        return MOVING
    if kind.startswith(INTEGER):
        return INT8
    if kind == "MatMulNBits":
        return "int4 weights"
    first = dtypes.partition(" ")[0]
    return {"float": FLOAT32, "": FLOAT32, "double": "float64", "uint8": INT8, "int8": INT8}.get(first, first)


class _OpenvinoProfiled:
    """OpenVINO counts the time of every node of a compiled model when it is told to."""

    def __init__(self, path: Path, threads: int, compute: str, _scratch: Path) -> None:
        openvino = require("openvino", "openvino")
        settings = {**settings_for(threads, compute), "PERF_COUNT": True}
        try:
            core = openvino.Core()
            model = core.read_model(str(path))
            known = {node.get_friendly_name(): str(node.get_type_name()) for node in model.get_ops()}
            self._compiled = compiled(core, model, settings)
            self._request = self._compiled.create_infer_request()
            self._fused = fused_names(self._compiled, known)
        except Exception as error:  # the seam: every exception type of OpenVINO becomes ours
            raise GraphError(f"OpenVINO cannot profile {path.name}: {str(error)[:200]}") from error
        self._outputs = [output.get_any_name() for output in self._compiled.outputs]
        self._runs: list[dict[tuple[str, str, str], float]] = []

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        self._request.infer(feeds)
        spent: dict[tuple[str, str, str], float] = {}
        for item in self._request.profiling_info:
            if str(item.status).endswith("EXECUTED"):
                named = self._fused.get(item.node_name, (item.node_name, item.node_type))
                key = (*named, item.exec_type)
                spent[key] = spent.get(key, 0.0) + item.real_time.total_seconds() * 1e6
        self._runs.append(spent)
        outputs = enumerate(self._outputs)
        return {name: np.array(self._request.get_output_tensor(index).data) for index, name in outputs}

    def times(self) -> list[dict[tuple[str, str, str], float]]:
        return self._runs


def fused_names(compiled: Any, known: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return subgraph -> name of the node of the file that it mostly is, and its kind: with its product, if it has one.

    OpenVINO fuses small operators, and whole attentions, into a Subgraph that it names after its last one, which is
    often the quantization of what it gives.

    Args:
        compiled: The compiled model.
        known: Name of each node as it was read -> its operator type.
    """
    found: dict[str, tuple[str, str]] = {}
    for node in compiled.get_runtime_model().get_ops():
        about = node.get_rt_info()
        if str(about["layerType"].astype(str)) != "Subgraph":
            continue
        inside = [name for name in str(about["originalLayersNames"].astype(str)).split(",") if name in known]
        computing = [name for name in inside if not _is_quantizer(name) and known[name] != "FakeQuantize"]
        product = next((name for name in computing if known[name] == "MatMul"), "")
        if computing:
            found[node.get_friendly_name()] = (product or computing[0], "Subgraph (MatMul)" if product else "Subgraph")
    return found


def _is_quantizer(name: str) -> bool:
    return "quantize" in name.lower()


PROFILERS: Mapping[str, Callable[[Path, int, str, Path], _Profiled]] = {
    "ort_cpu": _OrtProfiled,
    "openvino": _OpenvinoProfiled,
}


def _openvino_precision(name: str, kind: str, kernel: str) -> str:
    if kind in MOVES:
        return MOVING
    if kind in QUANTIZES or (kind == "Subgraph" and _is_quantizer(name)):
        return QUANTIZING
    ending = kernel.rpartition("_")[2].lower()
    return {"i8": INT8, "u8": INT8, "bf16": BFLOAT16, "f32": FLOAT32, "fp32": FLOAT32, "f16": "float16"}.get(
        ending, ending
    )


def shares(operators: Iterable[Operator]) -> dict[str, float]:
    """Return precision -> share of the time (0-1), the groups first and in their order."""
    spent: Counter[str] = Counter()
    listed = list(operators)
    total = sum(each.ms for each in listed) or 1.0
    for each in listed:
        spent[each.precision] += each.ms  # type: ignore[assignment]
    order = [*(group for group in GROUPS if group in spent), *(name for name in spent if name not in GROUPS)]
    return {name: spent[name] / total for name in order}


def table(operators: Iterable[Operator], most: int = 14) -> list[dict[str, Any]]:
    """Return rows of operator type, calls, ms, share (per cent) and effective precision; the slowest first."""
    sums: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
    for each in operators:
        found = sums[each.kind, each.precision]
        found[0] += each.calls
        found[1] += each.ms
    total = sum(spent for _, spent in sums.values()) or 1.0
    ordered = sorted(sums.items(), key=lambda item: -item[1][1])
    rows = [_table_row(kind, precision, calls, spent, total) for (kind, precision), (calls, spent) in ordered[:most]]
    rest = [numbers for _, numbers in ordered[most:]]
    if rest:
        calls, spent = (sum(numbers[index] for numbers in rest) for index in (0, 1))
        rows.append(_table_row(f"{len(rest)} others", "", calls, spent, total))
    return rows


def _table_row(kind: str, precision: str, calls: float, spent: float, total: float) -> dict[str, Any]:
    numbers = {"calls": int(calls), "ms": round(spent, 4), "share %": round(100 * spent / total, 1)}
    return {"operator": kind, "computed as": precision, **numbers}
