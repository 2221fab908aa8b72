"""Options of weight-only quantization."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from vlatool.data import MAP_HELP
from vlatool.quantize._base import Quantization
from vlatool.quantize.streamed._block_quantization import BlockFormat


class WeightOptions(Quantization):
    """Options of weight-only quantization, and values derived from them."""

    bits: Literal[4, 8] = Field(4, description="bits of a weight: 4 or 8")
    block: Literal[32, 64, 128] = Field(32, description="weights that share a scale: 32, 64 or 128")
    method: Literal["rtn", "hqq", "gptq", "awq"] = Field("rtn", description="how weights are rounded")
    symmetric: bool = Field(False, description="fix the zero point in the middle")
    search: bool = Field(True, description="4 bits, rtn and awq: try several ranges for each block")
    layout: Literal["ort", "qdq"] = Field("ort", description="MatMulNBits, or blocked DequantizeLinear (opset 21)")
    accuracy_level: int = Field(4, ge=0, le=4, description="MatMulNBits: 4 rounds activations to int8, 1 does not")
    embeddings: Literal["float16", "float32"] = Field("float16", description="dtype of embedding tables")
    calibration: Path | None = Field(None, description="recorded observations for gptq and awq")
    map: tuple[str, ...] = Field((), description=MAP_HELP)
    samples: int = Field(
        64, ge=1, description="calibration samples for gptq and awq, spread over the recording; up to 1024 of states"
    )
    verify: Literal["auto", "layers", "run"] = Field(
        "auto", description="compare each layer's weights, or also run the new bundle; auto runs below 1 GiB"
    )

    @property
    def block_format(self) -> BlockFormat:
        """Format of a quantized weight."""
        return BlockFormat(self.bits, self.block, self.symmetric)

    @property
    def choose(self) -> str:
        """Method that finds scale and zero point of a block: a name in ``METHODS``."""
        if self.method == "hqq":
            return "hqq"
        return "searched" if self.search and self.bits == 4 else "rtn"
