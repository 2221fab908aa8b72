"""Dynamic int8: scales of weights ahead of time, of activations at run time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError
from vlatool.files.printable import amount
from vlatool.graph.files import load, save
from vlatool.graph.layers import Layer, check_weights, copy_inner_gemm_weights, split_gemms
from vlatool.graph.onnx_graph import OnnxGraph
from vlatool.graph.qdq import quantize_weight
from vlatool.machine.instruction_sets import saturates
from vlatool.quantize._base import (
    REDUCE_RANGE,
    REDUCE_RANGE_NOTE,
    Quantization,
    fit_range_to_host,
    name_float_layers,
    silenced_quantizer,
)
from vlatool.runtime.engines import build_tool
from vlatool.stage.base import Context, Result
from vlatool.weights.pairs import largest_sums

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

OPS = ("MatMul", "Gemm")
CODES, SCALES = "_quantized", "_scale"
"""Suffixes of the tensors that ONNX Runtime's quantizer stores for a weight."""


class DynamicInt8(Quantization):
    """Quantize weights of MatMul and Gemm to int8; activations get their scale at run time (uint8, per tensor).

    Needs no calibration data. Convolutions stay in float32: dynamic int8 convolutions (ConvInteger) are slower than
    float32 ones on every CPU measured.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    per_channel: bool = Field(True, description="one weight scale for each output channel")
    reduce_range: bool = Field(False, description=REDUCE_RANGE)

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Quantize every selected graph."""
        layers = self.selected_layers(source, OPS)

        def quantize(name: str, original: Path, target: Path) -> None:
            self._quantize(load(original), target, layers[name])

        return name_float_layers(self.transform(source, out, context, quantize), layers)

    def _quantize(self, model: Any, target: Path, layers: list[Layer]) -> None:
        quantization, names = build_tool("quantization"), {layer.name for layer in layers}
        check_weights(model, layers)
        split_gemms(model)  # ONNX Runtime's own rewrite transposes a weight in place for each of its readers
        copy_inner_gemm_weights(model)
        excluded = [node.name for node in model.graph.node if node.op_type in OPS and node.name not in names]
        with silenced_quantizer() as scratch:
            quantization.quantize_dynamic(
                model,
                scratch / "model.onnx",
                op_types_to_quantize=list(OPS),
                per_channel=self.per_channel,
                weight_type=quantization.QuantType.QInt8,
                nodes_to_exclude=[*excluded, *(f"{name}_MatMul" for name in excluded)],
                extra_options={"MatMulConstBOnly": True},
            )
            quantized = load(scratch / "model.onnx")
            left = [node.name for node in quantized.graph.node if node.op_type in OPS and node.name in names]
            if left:
                raise GraphError(
                    f"ONNX Runtime's quantizer leaves {len(left)} of {amount(len(names), 'layer')} in float32: "
                    f"{', '.join(left[:3])}.",
                    "exclude them: " + " ".join(f"--exclude '{name}'" for name in left[:3]),
                )
            if self.reduce_range:
                self._fit_pairs(quantized, OnnxGraph(model))
            save(quantized, target)

    def _fit_pairs(self, quantized: Any, original: OnnxGraph) -> None:
        """Replace the codes and scales of weights by ones of which no pair saturates, in place."""
        graph = OnnxGraph(quantized)
        for name in [name.removesuffix(CODES) for name in graph.constants if name.endswith(CODES)]:
            values = original.array(name)
            last = values.ndim - 1
            axis = last if graph.constants[f"{name}{SCALES}"].dims else None
            codes, scales = quantize_weight(values, axis, name, sums=largest_sums(values, "MatMul", last))
            for ending, array in ((CODES, codes), (SCALES, scales)):
                tensor = graph.constants[f"{name}{ending}"]
                stored = graph.onnx.numpy_helper.from_array(array.reshape(tuple(tensor.dims)), tensor.name)
                tensor.CopyFrom(stored)

    def on(self, board: Profile | None) -> Self:
        """Use weights without saturation where the board, or this host, saturates."""
        if board is None:
            return fit_range_to_host(self, "")
        narrow = saturates(board.units[board.engines[board.engine].unit].isa)
        return self.unless_given({"reduce_range": True} if narrow else {})

    def summarize(self, bundle: Bundle) -> tuple[str, ...]:
        """Report that the weights are meant for processors without VNNI."""
        return (REDUCE_RANGE_NOTE,) if self.reduce_range else ()
