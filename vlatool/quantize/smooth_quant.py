"""SmoothQuant: move the outliers of activations into weights, before quantization."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError
from vlatool.files.printable import amount
from vlatool.graph.files import foreign_errors, load, save
from vlatool.graph.nodes import reads
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.quantize._calibrated_base import CalibratedQuantization
from vlatool.quantize.calibration.activation_statistics import calibrate
from vlatool.quantize.calibration.samples import recorded_moments
from vlatool.quantize.int8.smoothing_groups import ConstantEdit, SmoothingGroup, find_groups
from vlatool.quantize.int8.smoothing_scales import PeakExcess, best_alpha, int8_loss, smooth_scales, weight_peaks
from vlatool.runtime.golden import load_golden
from vlatool.runtime.interface import Array
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context, Result
from vlatool.stage.record import SampleSet

OPS = ("MatMul", "Gemm")
REPORT = "reports/smooth_quant.json"
MAX_CHANGE = 1e-4
"""Largest relative L2 difference of the golden action from the source's: no more than float32 rounding."""


def _alpha(value: Any) -> str:
    """Validate a number from 0 to 1, or ``auto``, and return it as text."""
    text = str(value).strip()
    if text == "auto":
        return text
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0 <= number <= 1:
        raise ValueError("must be a number from 0 to 1, or auto")
    return repr(number)


class SmoothQuant(CalibratedQuantization):
    """Move outlier channels of activations into the weights that read them; the result is equivalent in float32.

    Run a quantization after it. Each input channel of a MatMul or Gemm is divided by a scale and its row of the weight
    multiplied by it (Xiao et al., SmoothQuant, 2022). The division costs nothing where constants before the layer
    absorb it: those of LayerNormalization, RMSNorm or a linear layer, through ReLU, sums, and products with other
    activations. Outputs of GELU or attention can be divided only by an inserted Mul (--insert).
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    alpha: Annotated[str, BeforeValidator(_alpha)] = Field(
        "0.5", description="0 to 1: share of outliers moved into the weights; auto: by the int8 error of each layer"
    )
    outliers: float = Field(
        1.0, ge=1, description="smooth activations whose largest channel is this many times the median one"
    )
    insert: bool = Field(False, description="insert a Mul where the division cannot be folded into constants")

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Calibrate, smooth every selected graph, and compare the golden action with the source's."""
        groups, samples = {}, SampleSet()
        for name, layers in self.selected_layers(source, OPS).items():
            with foreign_errors(name):
                groups[name] = find_groups(load(source.file(source.manifest.graphs[name].file)), layers)
        values = {name: [value for group in members for value in group.activations] for name, members in groups.items()}
        recording, chosen = self.calibration_samples(source)
        halves = self._halves(chosen)
        peaks = []
        for numbers in halves:
            observations = recorded_moments(source, recording, numbers, samples)
            statistics = calibrate(source, values, observations, context, channels=True, numbers=numbers)
            peaks.append({graph: {name: np.asarray(seen.peaks) for name, seen in collected.items()}
                          for graph, collected in statistics.items()})  # fmt: skip
        notes: list[dict[str, Any]] = []

        def smooth(name: str, original: Path, target: Path) -> None:
            model = load(original)
            for group in groups[name]:
                largest = [np.maximum.reduce([half[name][value] for value in group.activations]) for half in peaks]
                notes.append({"graph": name, **self._smooth(model, group, largest, sum(map(len, halves)))})
            save(model, target)

        result = self.transform(source, out, context, smooth, samples=samples)
        (out / REPORT).parent.mkdir(exist_ok=True)
        (out / REPORT).write_text(json.dumps({"groups": notes}, indent=1) + "\n", encoding="utf-8")
        _check_same(source, result.bundle)
        return result

    @property
    def golden_recording(self) -> None:
        """None, for that of the smoothed bundle: its golden action must not change."""

    def summarize(self, smoothed: Bundle) -> tuple[str, ...]:
        """Return a summary of the new bundle for the user."""
        groups = json.loads((smoothed.path / REPORT).read_text(encoding="utf-8"))["groups"]
        count = {how: sum(group["how"] == how for group in groups) for how in ("folded", "inserted", "left")}
        layers = sum(len(group["layers"]) for group in groups if group["how"] != "left")
        text = f"smoothed the inputs of {amount(layers, 'layer')}: {count['folded']} scales folded, "
        text += f"{count['inserted']} inserted"
        blocked = sum(group["why"] == "only a Mul of its own could divide it" for group in groups)
        more = f" ({blocked} of them need --insert)" if blocked else ""
        return (f"{text}, {count['left']} unchanged{more}",)

    def _halves(self, numbers: list[int]) -> list[list[int]]:
        """Return all samples in one part; for ``auto`` in two interleaved halves, whose peaks are compared."""
        if self.alpha != "auto" or len(numbers) < 2:
            return [numbers]
        return [numbers[::2], numbers[1::2]]

    def _smooth(self, model: Any, group: SmoothingGroup, halves: list[Array], samples: int) -> dict[str, Any]:
        """Smooth one activation in place and return a record of it."""
        peaks = np.maximum.reduce(halves)
        excess = PeakExcess.between(halves[0], halves[-1], samples)
        median = float(np.median(peaks))
        ratio = float(peaks.max()) / median if median else 0.0
        note = {"value": group.value, "layers": [layer.name for layer in group.layers], "outliers": round(ratio, 3)}
        if ratio < self.outliers:
            return {**note, "how": "left", "why": "it has no outlier channels"}
        if not group.edits and not self.insert:
            return {**note, "how": "left", "why": "only a Mul of its own could divide it"}
        writer = _Writer(model)
        weights = [writer.weight(layer.weight, layer.axis) for layer in group.layers]
        alpha: float | None
        if self.alpha == "auto":
            alpha, scales = best_alpha(peaks, weights, excess)
        else:
            alpha = float(self.alpha)
            scales = smooth_scales(peaks, weight_peaks(weights), alpha)
        if alpha is None:
            return {**note, "how": "left", "why": "no alpha lowers the estimated error"}
        plain = int8_loss(peaks, weights, np.ones_like(scales), excess)
        gain = int8_loss(peaks, weights, scales, excess) / plain if plain else 1.0
        writer.apply(group, scales)
        how = "folded" if group.edits else "inserted"
        return {**note, "how": how, "why": "", "alpha": alpha, "estimated_loss": float(f"{gain:.4g}")}


class _Writer(OnnxGraph):
    """Multiplies constants of a graph in place, one reader's copy at a time."""

    def weight(self, name: str, axis: int) -> Array:
        """Return a weight as (inputs, outputs)."""
        return self.array(name) if axis == 1 else self.array(name).T

    def apply(self, group: SmoothingGroup, scales: Array) -> None:
        """Divide the value of a group by the scales and multiply its weights by them."""
        names = {layer.name for layer in group.layers}
        layers = {node.name: node for node in self.graph.node if node.name in names}
        for edit in group.edits:
            self._multiply(edit, scales)
        for layer in group.layers:
            self._multiply(ConstantEdit(layers[layer.name].output[0], 1, 1 - layer.axis, power=1), scales)
        if not group.edits:  # insert a Mul before the layers
            value, smooth = group.value, f"{group.value}.smooth"
            factors = self.add(f"{smooth}.scale", _reciprocals(scales))
            for node in layers.values():
                node.input[0] = smooth
            first = next(iter(layers.values()))
            self.insert_before(first, self.node("Mul", [value, factors], [smooth], f"{value}/smooth"))

    def _multiply(self, edit: ConstantEdit, scales: Array) -> None:
        node = self.producers[edit.node]
        name = self._unshare(node, edit.position)
        values = self.array(name)
        if edit.width and values.shape[-1:] != (edit.width,):
            values = np.broadcast_to(values, (*values.shape[:-1], edit.width))
        values = np.array(values, np.float32)
        axis = edit.axis % values.ndim
        index = (*(slice(None),) * axis, slice(edit.start, edit.start + len(scales)))
        factors = scales if edit.power > 0 else _reciprocals(scales)
        values[index] *= factors.reshape(-1, *(1,) * (values.ndim - 1 - axis))
        self.constants[name].CopyFrom(self.onnx.numpy_helper.from_array(values, name))

    def _unshare(self, node: Any, position: int) -> str:
        """Return the name of a constant that only this input of the node reads; copy a shared one."""
        name = str(node.input[position])
        if sum(list(reads(reader)).count(name) for reader in self.graph.node) > 1:
            node.input[position] = self.add_tensor(self.constants[name], f"{name}.{node.name}.{position}")
        return str(node.input[position])


def _reciprocals(scales: Array) -> Array:
    return (1 / scales.astype(np.float64)).astype(np.float32)


def _check_same(source: Bundle, smoothed: Bundle) -> None:
    """Refuse a bundle whose golden action is not the source's."""
    before, after = load_golden(source), load_golden(smoothed)
    if before is None or after is None or not _equal(before[:2], after[:2]):
        return
    error = relative_error(after[2], before[2])
    if not error <= MAX_CHANGE:
        raise GraphError(f"Smoothing changed the golden action by {error:.3g}; allowed: {MAX_CHANGE:g}.", "report this")


def _equal(first: Iterable[dict[str, Any]], second: Iterable[dict[str, Any]]) -> bool:
    return all(
        one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
        for one, other in zip(first, second, strict=True)
    )
