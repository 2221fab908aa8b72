"""Static int8: weights and activations with scales that are fixed ahead of time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.graph.files import load, read, save
from vlatool.graph.layers import (
    Layer,
    Style,
    calibrated_values,
    check_weights,
    convolution_inputs,
    find_layers,
    hoisted_values,
    split_gemms,
)
from vlatool.graph.qdq import Range, insert_qdq
from vlatool.machine.instruction_sets import saturates
from vlatool.quantize._base import (
    QUANTIZED_OPS,
    REDUCE_RANGE,
    REDUCE_RANGE_NOTE,
    check_ops,
    fit_range_to_host,
    name_float_layers,
)
from vlatool.quantize._calibrated_base import CalibratedQuantization
from vlatool.quantize._trial_compile import open_in_child
from vlatool.quantize.calibration.ranges import Statistics, choose_range
from vlatool.quantize.int8.convolutions import use_convolutions
from vlatool.quantize.int8.frame_normalization import fold_normalization
from vlatool.quantize.int8.integer_matmul import use_integer_matmul
from vlatool.quantize.int8.quantizer_hoisting import hoist_quantizers
from vlatool.quantize.int8.reductions import keep_reduced_axes
from vlatool.runtime.engine import DEFAULT_ENGINE, STANDARD_LAYOUT, Engine, Int8Layout, class_for, engine_class, layouts
from vlatool.stage.base import Context, Result
from vlatool.stage.record import SampleSet

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

    LayoutName = str
else:
    LayoutName = Literal[tuple(layouts())]


CRASH_FIX = "quantize fewer: leave out --elementwise or --attention, or use --exclude"


class StaticInt8(CalibratedQuantization):
    """Quantize MatMul, Gemm and Conv to int8 with activation ranges from calibration data.

    The default is the fastest form for ONNX Runtime on an x86 processor: uint8 activations, symmetric int8 weights, its
    own integer MatMul. ``openvino`` writes standard QDQ operators where OpenVINO expects them; ``qdq`` with ``int8``
    activations is the form for TensorRT and ARM.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")
    alternative: ClassVar[str] = ", or use quantize.dynamic_int8, which needs none"

    method: Literal["minmax", "entropy", "percentile", "mse"] = Field(
        "minmax", description="how activation ranges are chosen"
    )
    percentile: float = Field(99.99, gt=50, le=100, description="for the method percentile")
    activations: Literal["auto", "uint8", "int8"] = Field(
        "auto",
        description="activation type; auto: uint8, and for openvino int8 into products, where its kernels are faster "
        "(convolutions there always read uint8)",
    )
    per_channel: bool = Field(True, description="one weight scale for each output channel")
    reduce_range: bool = Field(False, description=REDUCE_RANGE)
    layout: LayoutName = Field(
        "ort",
        description="ort: ONNX Runtime's integer MatMul; qdq: standard operators, for TensorRT; openvino: for OpenVINO",
    )
    compute: Literal["float32", "bfloat16"] = Field(
        "float32", description="dtype of what is not quantized; bfloat16 needs the layout openvino"
    )
    attention: bool = Field(False, description="also quantize the products inside attention (of two activations)")
    elementwise: bool = Field(False, description="also quantize sums of two activations (residual connections)")
    convolutions: bool = Field(
        False,
        description="write products of many rows as 1x1 convolutions, faster on processors with AMX; for openvino",
    )
    ops: tuple[str, ...] = Field(QUANTIZED_OPS, description="operator types to quantize")

    @property
    def int8_layout(self) -> Int8Layout:
        """Properties of the layout."""
        return layouts()[self.layout][0]

    @property
    def engine(self) -> str:
        """Engine of the layout; empty for the default engine, and for a layout of standard operators."""
        name = layouts()[self.layout][1]
        return "" if name == DEFAULT_ENGINE else name

    @property
    def style(self) -> Style:
        """Style of the quantized layers."""
        layout = self.int8_layout
        kind: Literal["uint8", "int8", "symmetric"] = "uint8"
        if self.activations != "auto":
            kind = self.activations
        elif layout.symmetric and not self.convolutions:
            kind = "symmetric"
        second = layout.integer and kind == "uint8"
        return Style(
            kind, self.per_channel, self.reduce_range, layout.fuses_convolutions, hoist=layout.symmetric,
            signed_second=second, unsigned_convolutions=layout.symmetric
        )  # fmt: skip

    def on(self, board: Profile | None) -> Self:
        """Use layout and activations of the board's preferred engine, and weights that do not saturate where it does.

        Without a board, weights are for this host, unless the layout is the standard one, which may be for any board.
        """
        if board is None:
            return self if self.layout == STANDARD_LAYOUT else fit_range_to_host(self, self.engine)
        options = dict(class_for(board.engine).int8)
        if saturates(board.units[board.engines[board.engine].unit].isa):
            options["reduce_range"] = True
        return self.unless_given(options)

    def summarize(self, bundle: Bundle) -> tuple[str, ...]:
        """Return the note that the weights are meant for processors without VNNI."""
        return (REDUCE_RANGE_NOTE,) if self.reduce_range else ()

    def used_packages(self) -> tuple[str, ...]:
        """Return the packages of the stage, with the engine of the layout."""
        return (*self.packages, engine_class(self.engine).package) if self.engine else self.packages

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that operators, layout and engine support the options, and that there is calibration data."""
        check_ops(self.ops)
        library: type[Engine] = engine_class(self.engine)
        if self.compute not in library.computes:
            raise RecipeError(
                f"The layout {self.layout} does not compute in {self.compute}.",
                f"use layout {_capable_layouts(lambda layout, library: self.compute in library.computes)}",
            )
        if self.convolutions and not self.int8_layout.convolutions:
            raise RecipeError(
                f"The layout {self.layout} does not use convolutions.",
                f"use layout {_capable_layouts(lambda layout, library: layout.convolutions)}",
            )
        if self.engine:
            library.library()
        super().check(source, profile)

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Calibrate and quantize every selected graph."""
        layers, values = self.plan(source)
        samples = SampleSet()
        statistics = self.statistics(source, values, samples, context, _values_read_by_sums_only(layers))
        layers = {name: _finite_layers(chosen, statistics[name]) for name, chosen in layers.items()}

        def quantize(name: str, original: Path, target: Path) -> str:
            model = load(original)
            pixels: dict[str, Range] = {}
            if self.int8_layout.integer:
                split_gemms(model)
                if self.style.activations == "uint8":
                    pixels = fold_normalization(model, {layer.name for layer in layers[name]})
            chosen = self._layers_after_split(model, layers[name])
            unsigned = convolution_inputs(chosen, self.style, hoisted_values(model, chosen, self.style))
            insert_qdq(model, chosen, {**self.ranges(statistics[name], unsigned), **pixels}, self.style)
            if self.int8_layout.integer:
                hoist_quantizers(model)
                use_integer_matmul(model)
            if self.int8_layout.symmetric:
                keep_reduced_axes(model)
            if self.convolutions:
                use_convolutions(model)
            save(model, target)
            if self.int8_layout.crashes and (self.elementwise or self.attention or self.convolutions):
                open_in_child(target, self.engine, "int8", CRASH_FIX)
            return "" if self.compute == "float32" else self.compute

        result = self.transform(source, out, context, quantize, self.engine, samples)
        return name_float_layers(result, layers)

    def ranges(self, statistics: Mapping[str, Statistics], unsigned: Collection[str] = ()) -> dict[str, Range]:
        """Return value -> quantization range (low, high); ``unsigned`` values are uint8 where others are symmetric."""
        kind = self.style.activations
        symmetric = {name: kind in ("int8", "symmetric") and name not in unsigned for name in statistics}
        return {
            name: choose_range(seen, self.method, self.percentile, symmetric[name], kind == "symmetric")
            for name, seen in statistics.items()
        }

    def plan(self, bundle: Bundle) -> tuple[dict[str, list[Layer]], dict[str, list[str]]]:
        """Return graph -> layers to quantize, and graph -> values whose ranges they need."""
        layers = self.selected_layers(bundle, self.ops, attention=self.attention, elementwise=self.elementwise)
        values = {}
        for name, chosen in layers.items():
            model = read(bundle.file(bundle.manifest.graphs[name].file))
            check_weights(model, chosen)
            values[name] = calibrated_values(chosen, self.style, hoisted_values(model, chosen, self.style))
        return layers, values

    def _layers_after_split(self, model: Any, layers: list[Layer]) -> list[Layer]:
        """Return the layers as they are once each Gemm has become a MatMul."""
        if not self.int8_layout.integer:
            return layers
        names = {layer.name for layer in layers}
        again = find_layers(model, QUANTIZED_OPS, attention=self.attention)
        return [layer for layer in again if layer.name in names] + [layer for layer in layers if layer.kind == "Add"]


def _values_read_by_sums_only(layers: Mapping[str, list[Layer]]) -> dict[str, set[str]]:
    """Return graph -> values that only sums of two activations read; a sum without a range stays float32."""
    read = {
        name: [{value for layer in chosen if (layer.kind == "Add") is sums for value in layer.activations}
               for sums in (True, False)]
        for name, chosen in layers.items()
    }  # fmt: skip
    return {name: sums - others for name, (sums, others) in read.items()}


def _finite_layers(layers: list[Layer], statistics: Mapping[str, Statistics]) -> list[Layer]:
    """Return the layers with finite activations: without those that read a mask or an input with infinity."""
    infinite = {name for name, seen in statistics.items() if not seen.finite}
    return [layer for layer in layers if infinite.isdisjoint(layer.activations)]


def _capable_layouts(fits: Callable[[Int8Layout, type[Engine]], bool]) -> str:
    """Return the names of the suitable layouts, joined by "or"."""
    names = [name for name, (layout, engine) in layouts().items() if fits(layout, engine_class(engine))]
    return " or ".join(names) or "none"
