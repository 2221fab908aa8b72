"""float8 (E4M3): for GPUs with float8 matrix units, through TensorRT."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.errors import require
from vlatool.graph.files import load, save
from vlatool.graph.layers import Style, calibrated_values
from vlatool.quantize._base import QUANTIZED_OPS, check_ops
from vlatool.quantize._calibrated_base import CalibratedQuantization
from vlatool.quantize.floats.float8_qdq import Float8Writer
from vlatool.stage.base import Context, Result
from vlatool.stage.record import SampleSet

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


class Float8(CalibratedQuantization):
    """Quantize MatMul, Gemm and Conv to float8 (E4M3) in QDQ form, for TensorRT on Jetson Thor and newer GPUs.

    Weights have one scale for each output channel, activations one for all, from the largest magnitude on calibration
    data. No such GPU was available: only the numbers are tested, in ONNX Runtime on a CPU, which computes float8 values
    in float32 and gains no time. E4M3 has 4 significant bits: where activations have no outliers, int8 with a
    calibrated range loses less.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "onnxruntime", "ml_dtypes", "numpy")
    alternative: ClassVar[str] = ", or use quantize.float16, which needs none"

    per_channel: bool = Field(True, description="one weight scale for each output channel")
    attention: bool = Field(False, description="also quantize the products inside attention (of two activations)")
    ops: tuple[str, ...] = Field(QUANTIZED_OPS, description="operator types to quantize")

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that the operators can be quantized, and that there is calibration data."""
        check_ops(self.ops)
        super().check(source, profile)

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Calibrate and quantize every selected graph."""
        require("ml_dtypes", "build")
        layers, samples = self.selected_layers(source, self.ops, attention=self.attention), SampleSet()
        values = {name: calibrated_values(graph, Style(), {}) for name, graph in layers.items()}
        statistics = self.statistics(source, values, samples, context)

        def quantize(name: str, original: Path, target: Path) -> None:
            model = load(original)
            peaks = {value: max(abs(seen.low), abs(seen.high)) for value, seen in statistics[name].items()}
            Float8Writer(model, layers[name], peaks, self.per_channel).write()
            save(model, target)

        return self.transform(source, out, context, quantize, samples=samples)
