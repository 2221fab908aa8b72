"""float8 (E4M3): for GPUs with float8 matrix units, through TensorRT."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, nearest, require
from vlatool.graph.files import foreign_errors, load, save
from vlatool.graph.layers import Layer, Style, calibrated_values, find_layers
from vlatool.quantize._base import QUANTIZED_OPS
from vlatool.quantize._calibration import Calibrated
from vlatool.quantize._float8_qdq import Float8Writer
from vlatool.stage.base import Context, SampleSet, source_of

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


class Float8(Calibrated):
    """Quantize MatMul, Gemm and Conv to float8 (E4M3) in QDQ form, for TensorRT on Jetson Thor and newer GPUs.

    Weights have one scale for each output channel, activations one for all, from the largest magnitude on calibration
    data. No such GPU was at hand: what is checked here is the numbers, in ONNX Runtime on the processor, which computes
    float8 values in float32 and gains no time. E4M3 has 4 significant bits: where activations have no outliers, int8
    with a range of its own loses less.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "ml_dtypes", "numpy")
    without: ClassVar[str] = ", or use quantize.float16, which needs none"

    per_channel: bool = Field(True, description="one weight scale for each output channel")
    attention: bool = Field(False, description="also quantize the products inside attention (of two activations)")
    ops: tuple[str, ...] = Field(QUANTIZED_OPS, description="operator types to quantize")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The operators are ones that can be quantized, and there is calibration data."""
        for name in self.ops:
            if name not in QUANTIZED_OPS:
                raise RecipeError(f"The operator '{name}' cannot be quantized; {nearest(name, QUANTIZED_OPS)}.")
        super().check(source, profile)

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Calibrate and quantize every selected graph."""
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        require("ml_dtypes", "build")
        with foreign_errors("main"):
            layers = self._layers(bundle)
        wanted = {name: calibrated_values(found, Style(), {}) for name, found in layers.items()}
        samples = SampleSet()
        statistics = self.statistics(bundle, wanted, samples, context)

        def quantize(name: str, original: Path, target: Path) -> None:
            model = load(original)
            peaks = {value: max(abs(found.low), abs(found.high)) for value, found in statistics[name].items()}
            Float8Writer(model, layers[name], peaks, self.per_channel).write()
            save(model, target)

        return self.transform(bundle, out, context, quantize, made_by=self.made_by(calibration=samples))

    def _layers(self, bundle: Bundle) -> dict[str, list[Layer]]:
        """Return graph -> selected layers."""
        paths = {name: bundle.file(bundle.manifest.graphs[name].file) for name in self.chosen_graphs(bundle)}
        found = {name: find_layers(load(path), self.ops, attention=self.attention) for name, path in paths.items()}
        selected = self.selected([layer.name for layers in found.values() for layer in layers], bundle)
        return {name: [layer for layer in layers if layer.name in selected] for name, layers in found.items()}
