"""Static int8: weights and activation ranges ahead of time."""

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
    convolved,
    find_layers,
    hoisted,
    split_gemm,
)
from vlatool.graph.qdq import Range, insert_qdq
from vlatool.machine.instruction_sets import saturates
from vlatool.quantize._base import (
    QUANTIZED_OPS,
    REDUCE_RANGE,
    REDUCED,
    check_ops,
    left_whole,
    reduced_on_this_host,
)
from vlatool.quantize._calibrated_base import Calibrated
from vlatool.quantize._trial_compile import open_apart
from vlatool.quantize.calibration.ranges import Statistics, choose_range
from vlatool.quantize.int8.convolutions import use_convolutions
from vlatool.quantize.int8.frame_normalization import fold_frames
from vlatool.quantize.int8.integer_matmul import use_integer_matmul
from vlatool.quantize.int8.quantizer_hoisting import quantize_early
from vlatool.quantize.int8.reductions import keep_axes
from vlatool.runtime.engine import (
    DEFAULT_ENGINE,
    STANDARD_LAYOUT,
    Engine,
    Int8Layout,
    class_for,
    engine_class,
    layouts,
)
from vlatool.stage.base import Context, SampleSet, source_of

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

    LayoutName = str
else:
    LayoutName = Literal[tuple(layouts())]


FEWER = "quantize fewer: leave out --elementwise or --attention, or use --exclude"


class StaticInt8(Calibrated):
    """Quantize MatMul, Gemm and Conv to int8 with activation ranges from calibration data.

    The default is what ONNX Runtime computes fastest on an x86 processor: uint8 activations, symmetric int8 weights,
    its own integer MatMul. ``openvino`` writes standard QDQ operators where OpenVINO wants them; ``qdq`` with ``int8``
    activations is what TensorRT and ARM take.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "numpy")
    without: ClassVar[str] = ", or use quantize.dynamic_int8, which needs none"

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
    def form(self) -> Int8Layout:
        """What the layout writes."""
        return layouts()[self.layout][0]

    @property
    def engine(self) -> str:
        """The engine that the layout is for; empty for any that runs standard operators, and for the default one."""
        name = layouts()[self.layout][1]
        return "" if name == DEFAULT_ENGINE else name

    @property
    def style(self) -> Style:
        """How layers are written."""
        form = self.form
        kind: Literal["uint8", "int8", "symmetric"] = "uint8"
        if self.activations != "auto":
            kind = self.activations
        elif form.symmetric and not self.convolutions:
            kind = "symmetric"
        second = form.integer and kind == "uint8"
        return Style(
            kind, self.per_channel, self.reduce_range, form.fuses_convolutions, hoist=form.symmetric,
            signed_second=second, unsigned_convolutions=form.symmetric,
        )  # fmt: skip

    def on(self, profile: Profile) -> Self:
        """Write the layout and the activations that the board's preferred engine takes."""
        options = dict(class_for(profile.engine).int8)
        if saturates(profile.units[profile.engines[profile.engine].unit].isa):
            options["reduce_range"] = True
        return self.model_copy(update={name: how for name, how in options.items() if name not in self.model_fields_set})

    def on_this_host(self) -> Self:
        """Write weights that do not saturate where this host would; the standard layout may be for any board."""
        if self.layout == STANDARD_LAYOUT:
            return self
        return reduced_on_this_host(self, self.engine)

    def lines(self, bundle: Bundle) -> tuple[str, ...]:
        """Say that the weights were made for processors without VNNI."""
        return (REDUCED,) if self.reduce_range else ()

    def used_packages(self) -> tuple[str, ...]:
        """The engine too that the layout is for."""
        return (*self.packages, engine_class(self.engine).package) if self.engine else self.packages

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The operators are ones that can be quantized, the layout can compute so, and there is calibration data."""
        check_ops(self.ops)
        library: type[Engine] = engine_class(self.engine)
        if self.compute not in library.computes:
            raise RecipeError(
                f"The layout {self.layout} does not compute in {self.compute}.",
                f"use layout {_other(lambda layout, library: self.compute in library.computes)}",
            )
        if self.convolutions and not self.form.convolutions:
            raise RecipeError(
                f"The layout {self.layout} has no use for convolutions.",
                f"use layout {_other(lambda layout, library: layout.convolutions)}",
            )
        if self.engine:
            library.library()
        super().check(source, profile)

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Calibrate and quantize every selected graph."""
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        layers, values = self.plan(bundle)
        samples = SampleSet()
        statistics = self.statistics(bundle, values, samples, context, _of_sums_alone(layers))
        layers = {name: _with_ranges(chosen, statistics[name]) for name, chosen in layers.items()}

        def quantize(name: str, original: Path, target: Path) -> str:
            model = load(original)
            context.said.extend(left_whole(name, model))
            pixels: dict[str, Range] = {}
            if self.form.integer:
                split_gemm(model)
                if self.style.activations == "uint8":
                    pixels = fold_frames(model, {layer.name for layer in layers[name]})
            chosen = self._rewritten(model, layers[name])
            unsigned = convolved(chosen, self.style, hoisted(model, chosen, self.style))
            insert_qdq(model, chosen, {**self.ranges(statistics[name], unsigned), **pixels}, self.style)
            if self.form.integer:
                quantize_early(model)
                use_integer_matmul(model)
            if self.form.symmetric:
                keep_axes(model)
            if self.convolutions:
                use_convolutions(model)
            save(model, target)
            if self.form.crashes and (self.elementwise or self.attention or self.convolutions):
                open_apart(target, self.engine, "int8", FEWER)
            return "" if self.compute == "float32" else self.compute

        made_by = self.made_by(calibration=samples)
        return self.transform(bundle, out, context, quantize, self.engine, made_by)

    def ranges(self, statistics: Mapping[str, Statistics], unsigned: Collection[str] = ()) -> dict[str, Range]:
        """Return value -> (low, high) that activations are quantized over.

        Args:
            statistics: Of each value.
            unsigned: Values that are written as uint8 where others are symmetric.
        """
        kind = self.style.activations
        symmetric = {name: kind in ("int8", "symmetric") and name not in unsigned for name in statistics}
        return {
            name: choose_range(seen, self.method, self.percentile, symmetric[name], kind == "symmetric")
            for name, seen in statistics.items()
        }

    def plan(self, bundle: Bundle) -> tuple[dict[str, list[Layer]], dict[str, list[str]]]:
        """Return graph -> layers that are quantized, and graph -> values whose ranges that needs."""
        layers = self.layers_of(bundle, self.ops, attention=self.attention, elementwise=self.elementwise)
        values = {}
        for name, chosen in layers.items():
            model = read(bundle.file(bundle.manifest.graphs[name].file))
            check_weights(model, chosen)
            values[name] = calibrated_values(chosen, self.style, hoisted(model, chosen, self.style))
        return layers, values

    def _rewritten(self, model: Any, layers: list[Layer]) -> list[Layer]:
        """Return the layers as they are after Gemm became MatMul."""
        if not self.form.integer:
            return layers
        names = {layer.name for layer in layers}
        again = find_layers(model, QUANTIZED_OPS, attention=self.attention)
        return [layer for layer in again if layer.name in names] + [layer for layer in layers if layer.kind == "Add"]


def _of_sums_alone(layers: Mapping[str, list[Layer]]) -> dict[str, set[str]]:
    """Return graph -> values that only sums of two activations read: a sum that has no range stays float32."""
    read = {
        name: [{value for layer in chosen if (layer.kind == "Add") is sums for value in layer.activations}
               for sums in (True, False)]
        for name, chosen in layers.items()
    }  # fmt: skip
    return {name: sums - others for name, (sums, others) in read.items()}


def _with_ranges(layers: list[Layer], statistics: Mapping[str, Statistics]) -> list[Layer]:
    """Return the layers whose activations were finite: a mask of -infinity, or an input that takes it, makes others."""
    infinite = {name for name, seen in statistics.items() if not seen.finite}
    return [layer for layer in layers if infinite.isdisjoint(layer.activations)]


def _other(fits: Callable[[Int8Layout, type[Engine]], bool]) -> str:
    """Return the layouts that can do something, in words."""
    names = [name for name, (layout, engine) in layouts().items() if fits(layout, engine_class(engine))]
    return " or ".join(names) or "none"
