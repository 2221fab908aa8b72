"""Dynamic int8: weights ahead of time, activations at run time."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.graph.files import load, save
from vlatool.graph.layers import Layer, check_weights, part_inner_gemms, split_gemm
from vlatool.quantize._base import Quantization, quiet_quantizer
from vlatool.runtime.engines import build_tool
from vlatool.stage.base import Context, source_of

OPS = ("MatMul", "Gemm")


class DynamicInt8(Quantization):
    """Quantize weights of MatMul and Gemm to int8; activations get their scale at run time (uint8, per tensor).

    Needs no calibration data. Convolutions stay in float32: dynamic int8 convolutions (ConvInteger) are slower than
    float32 ones on every CPU measured.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")

    per_channel: bool = Field(True, description="one weight scale for each output channel")
    reduce_range: bool = Field(False, description="7-bit weights, for x86 processors without VNNI")

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Quantize every selected graph."""
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        layers = self.layers_of(bundle, OPS)

        def quantize(name: str, original: Path, target: Path) -> None:
            self._quantize(original, target, layers[name])

        return self.transform(bundle, out, context, quantize)

    def _quantize(self, original: Path, target: Path, layers: list[Layer]) -> None:
        quantization = build_tool("quantization")
        model, names = load(original), {layer.name for layer in layers}
        check_weights(model, layers)
        split_gemm(model)  # ONNX Runtime's own way turns a weight in place for each of its readers
        part_inner_gemms(model)
        excluded = [node.name for node in model.graph.node if node.op_type in OPS and node.name not in names]
        with quiet_quantizer() as scratch:
            quantization.quantize_dynamic(
                model,
                scratch / "model.onnx",
                op_types_to_quantize=list(OPS),
                per_channel=self.per_channel,
                reduce_range=self.reduce_range,
                weight_type=quantization.QuantType.QInt8,
                nodes_to_exclude=[*excluded, *(f"{name}_MatMul" for name in excluded)],
                extra_options={"MatMulConstBOnly": True},
            )
            save(load(scratch / "model.onnx"), target)
