"""Quantization methods: from a bundle to one of lower precision."""

from vlatool.quantize._base import Quantization

__all__ = ["Quantization"]
