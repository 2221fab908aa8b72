"""float16: half the bytes of float32, and what GPUs and TensorRT compute fastest without calibration."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.data import Moment, calibration_recording, synthetic_observations
from vlatool.errors import GraphError
from vlatool.graph.files import load, save
from vlatool.graph.layers import check_opset
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.machine.risky import risky
from vlatool.quantize._base import Quantization
from vlatool.quantize._trial_compile import open_apart
from vlatool.quantize.calibration.samples import recorded_moments
from vlatool.quantize.floats.float16_graph import LARGEST, around, look_at_weights, phase_nodes, to_float16
from vlatool.quantize.floats.overflow import find_beyond
from vlatool.quantize.floats.underflow import find_small, too_small
from vlatool.runtime.engine import engine_class
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context, SampleSet, source_of

APART = "leave layers beside a Transpose in float32 with --exclude, or use another method"

LOWEST_OPSET = 10
"""``IsInf``, by which values beyond float16 are found, came with opset 10."""
MOVED = 0.02
"""Relative L2 change of what a graph gives above which every small number is kept, and that is told."""
BEYOND_ALL = 1e9
"""What stands for a change that is not finite."""


class Float16(Quantization):
    """Store weights and compute in float16; inputs and outputs stay float32.

    For GPUs and TensorRT, and for half the file: ONNX Runtime on a processor runs the result too, but casts most of it
    back to float32. In float32 stay excluded nodes, phases (what leads to Sin and Cos) and indices, constants beyond
    65504, and every value that goes beyond it on calibration data, with the nodes that give and read it; likewise what
    is so small that float16 loses it, where that changes what a node computes. Sums inside a product are not watched:
    an engine that adds up in float16 can overflow where the result does not.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    calibration: Path | None = Field(None, description="recorded observations; the bundle's own when not given")
    samples: int = Field(16, ge=1, description="samples on which values beyond float16 are looked for")

    def inputs(self) -> tuple[Path, ...]:
        """The calibration file."""
        return (self.calibration,) if self.calibration else ()

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Look for values beyond float16, then convert every selected graph."""
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        chosen = self.chosen_graphs(bundle)
        candidates = []
        for name in chosen:
            model = load(bundle.file(bundle.manifest.graphs[name].file))
            check_opset(OnnxGraph(model).opset, "float16", LOWEST_OPSET)
            candidates += [node.name for node in model.graph.node]
        selected = self.selected(candidates, bundle)
        samples = SampleSet()
        recording = calibration_recording(bundle, self.calibration)

        def seen(samples: SampleSet) -> Iterable[Moment | Mapping[str, Any]]:
            if recording is None:
                return samples.watch(synthetic_observations(bundle, self.samples))
            return recorded_moments(bundle, recording, recording.spread(self.samples), samples)

        beyond = find_beyond(bundle, chosen, seen(samples), LARGEST, context)
        report: dict[str, Any] = {"kept": 0, "subnormal_weights": 0, "beyond": [], "moved": {}}
        for graph, values in beyond.items():
            for value, excess in values.items():
                size = float(f"{excess.largest:.4g}")
                report["beyond"].append({"graph": graph, "value": value, "sample": excess.sample, "largest": size})
                context.tell(
                    f"{value} reaches {size:g} in sample {excess.sample}, beyond float16: it stays float32", None
                )

        small = find_small(bundle, chosen, seen(SampleSet()), context)

        def convert(name: str, original: Path, target: Path) -> None:
            model = load(original)
            always = {node.name for node in model.graph.node} - selected
            always |= phase_nodes(model) | around(model, beyond.get(name, {}))
            always.update(look_at_weights(model, always).beyond)
            for strict in (False, True):
                kept = always | too_small(model, small[name], always, strict)
                moved = _written(original, target, kept, small[name].feeds)
                if moved <= MOVED:
                    break
            report["kept"] += len(kept)
            report["subnormal_weights"] += look_at_weights(model, kept).subnormal
            report["moved"][name] = float(f"{moved:.2g}")

        made_by = {**self.made_by(calibration=samples), "float16": report}
        return self.transform(bundle, out, context, convert, made_by=made_by)

    def lines(self, made: Bundle) -> tuple[str, ...]:
        """Return what a person wants to know about the new bundle."""
        report = made.manifest.made_by["float16"]
        small = report["subnormal_weights"]
        lines = [f"{report['kept']} nodes stay float32; {small} weights are too small for all their bits"]
        for graph, moved in report["moved"].items():
            if moved > MOVED:
                lines.append(f"{graph}: what it gives moves by up to {moved:.2g} (relative L2) on calibration data")
        for excess in report["beyond"]:
            where = f"{excess['graph']}/{excess['value']} reaches {excess['largest']:g} in sample {excess['sample']}"
            lines.append(f"{where}: beyond float16, so its nodes stay float32")
        return tuple(lines)


def _written(original: Path, target: Path, kept: set[str], feeds: Sequence[Mapping[str, Any]]) -> float:
    """Write a graph in float16 apart from some nodes; return the largest relative L2 change of what it gives."""
    save(to_float16(load(original), kept), target)
    try:
        open_apart(target, "", "float16", APART)
    except GraphError:  # with what is transposed in float32 it does not
        model = load(original)
        kept |= {node.name for node in model.graph.node if node.op_type == "Transpose"}
        save(to_float16(model, kept), target)
        open_apart(target, "", "float16", APART)
    before, after = engine_class()(original, 1), engine_class()(target, 1)
    moved = 0.0
    for fed in feeds:
        with risky(engine_class(), f"ran {target.name}"):
            expected, got = before.run(fed), after.run(fed)
        floats = [name for name, value in expected.items() if value.dtype.kind == "f"]
        errors = [relative_error(got[name], expected[name]) for name in floats]
        moved = max([moved, *(error if error == error else math.inf for error in errors)])
    return min(moved, BEYOND_ALL)
