"""float16: half the bytes of float32, and the fastest type of GPUs and TensorRT without calibration."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.data import MAP_HELP, Moment, calibration_recording, synthetic_observations
from vlatool.errors import GraphError
from vlatool.graph.files import load, save
from vlatool.graph.layers import check_opset
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.machine.engine_calls import engine_call
from vlatool.quantize._base import Quantization
from vlatool.quantize._trial_compile import open_in_child
from vlatool.quantize.calibration.samples import recorded_moments
from vlatool.quantize.floats.float16_graph import FLOAT16_MAX, nodes_touching, phase_nodes, to_float16, weight_losses
from vlatool.quantize.floats.overflow import find_overflows
from vlatool.quantize.floats.underflow import measure_sizes, underflow_nodes
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context, Result
from vlatool.stage.record import SampleSet

CRASH_FIX = "leave layers beside a Transpose in float32 with --exclude, or use another method"

MIN_OPSET = 10
"""First opset with ``IsInf``, which the search for values beyond float16 needs."""
MAX_CHANGE = 0.02
"""Relative L2 change of a graph's outputs above which all small values stay float32, and the change is reported."""
NON_FINITE_CHANGE = 1e9
"""Number that stands for a change that is not finite."""


class Float16(Quantization):
    """Store weights and compute in float16; inputs and outputs stay float32.

    For GPUs and TensorRT, and for half the file size: ONNX Runtime runs the result on a CPU, too, but casts most of it
    back to float32. These stay in float32: excluded nodes, phases (arguments of Sin and Cos), indices, constants beyond
    65504, values that exceed it on calibration data with the nodes that produce and read them, and values so small that
    their loss in float16 would change the result of a node. Sums inside a product are not observed: an engine that
    accumulates in float16 can overflow even where the result does not.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    calibration: Path | None = Field(None, description="recorded observations; the bundle's own when not given")
    map: tuple[str, ...] = Field((), description=MAP_HELP)
    samples: int = Field(16, ge=1, description="samples in which to look for values beyond float16")

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Find values beyond float16, then convert every selected graph."""
        chosen = self.chosen_graphs(source)
        candidates = []
        for name in chosen:
            model = load(source.file(source.manifest.graphs[name].file))
            check_opset(OnnxGraph(model).opset, "float16", MIN_OPSET)
            candidates += [node.name for node in model.graph.node]
        selected = self.select_nodes(candidates, source)
        samples = SampleSet()
        recording = calibration_recording(source, self.recording)

        def observations(samples: SampleSet) -> Iterable[Moment | Mapping[str, Any]]:
            if recording is None:
                return samples.watch(synthetic_observations(source, self.samples))
            return recorded_moments(source, recording, recording.spread(self.samples), samples)

        overflows = find_overflows(source, chosen, observations(samples), FLOAT16_MAX, context)
        report: dict[str, Any] = {"kept": 0, "subnormal_weights": 0, "beyond": [], "moved": {}}
        for graph, values in overflows.items():
            for value, overflow in values.items():
                size = float(f"{overflow.largest:.4g}")
                report["beyond"].append({"graph": graph, "value": value, "sample": overflow.sample, "largest": size})
                context.progress(
                    f"{value} reaches {size:g} in sample {overflow.sample}, beyond float16: it stays float32", None
                )

        sizes = measure_sizes(source, chosen, observations(SampleSet()), context)

        def convert(name: str, original: Path, target: Path) -> None:
            model = load(original)
            always = {node.name for node in model.graph.node} - selected
            always |= phase_nodes(model) | nodes_touching(model, overflows.get(name, {}))
            always.update(weight_losses(model, always).overflowing)
            for strict in (False, True):
                kept = always | underflow_nodes(model, sizes[name], always, strict)
                change = _convert_and_compare(original, target, kept, sizes[name].feeds)
                if change <= MAX_CHANGE:
                    break
            report["kept"] += len(kept)
            report["subnormal_weights"] += weight_losses(model, kept).subnormal
            report["moved"][name] = float(f"{change:.2g}")

        return self.transform(source, out, context, convert, samples=samples, report={"float16": report})

    def summarize(self, quantized: Bundle) -> tuple[str, ...]:
        """Return a summary of the new bundle for the user."""
        report = quantized.manifest.made_by["float16"]
        small = report["subnormal_weights"]
        lines = [f"{report['kept']} nodes stay float32; {small} weights are subnormal in float16 and lose bits"]
        for graph, change in report["moved"].items():
            if change > MAX_CHANGE:
                lines.append(f"{graph}: its outputs change by up to {change:.2g} (relative L2) on calibration data")
        for overflow in report["beyond"]:
            value = f"{overflow['graph']}/{overflow['value']}"
            where = f"reaches {overflow['largest']:g} in sample {overflow['sample']}"
            lines.append(f"{value} {where}: beyond float16, so its nodes stay float32")
        return tuple(lines)


def _convert_and_compare(original: Path, target: Path, kept: set[str], feeds: Sequence[Mapping[str, Any]]) -> float:
    """Write a graph in float16 except for some nodes; return the largest relative L2 change of its outputs."""
    save(to_float16(load(original), kept), target)
    try:
        open_in_child(target, "", "float16", CRASH_FIX)
    except GraphError:  # it does not crash with Transpose in float32
        model = load(original)
        kept |= {node.name for node in model.graph.node if node.op_type == "Transpose"}
        save(to_float16(model, kept), target)
        open_in_child(target, "", "float16", CRASH_FIX)
    before, after = engine_class()(original, 1), engine_class()(target, 1)
    change = 0.0
    for feed in feeds:
        with engine_call(engine_class(), f"ran {target.name}"):
            expected, got = before.run(feed), after.run(feed)
        floats = [name for name, value in expected.items() if value.dtype.kind == "f"]
        errors = [relative_error(got[name], expected[name]) for name in floats]
        change = max([change, *(error if error == error else math.inf for error in errors)])
    return min(change, NON_FINITE_CHANGE)
