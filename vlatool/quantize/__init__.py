"""Make a bundle of lower precision."""

from vlatool.quantize._base import Quantization

__all__ = ["Quantization"]
