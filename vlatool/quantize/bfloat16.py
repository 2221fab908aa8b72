"""bfloat16: the type of the processor's matrix units, at half the bytes of float32."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.graph.files import load, save
from vlatool.quantize._base import Quantization
from vlatool.quantize.int8.convolutions import use_convolutions
from vlatool.runtime.engine import computing, engine_class
from vlatool.stage.base import Context, Result

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


class Bfloat16(Quantization):
    """Compute in bfloat16 with OpenVINO; the weights stay float32 in the file.

    Phases (arguments of Sin and Cos: positions, denoising time) stay in float32, in a separate graph: bfloat16 has 8
    significant bits, and the sine of a large argument would be noise.
    """

    packages: ClassVar[tuple[str, ...]] = ("onnx", "openvino", "numpy")

    convolutions: bool = Field(
        False, description="write products of many rows as 1x1 convolutions, faster on processors with AMX"
    )

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Check that an engine for bfloat16 is installed."""
        super().check(source, profile)
        engine_class(computing("bfloat16")).library()

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Mark every selected graph."""

        def mark(_name: str, original: Path, target: Path) -> str:
            model = load(original)
            if self.convolutions:
                use_convolutions(model)
            save(model, target)
            return "bfloat16"

        return self.transform(source, out, context, mark, computing("bfloat16"))
