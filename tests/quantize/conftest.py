"""Fixtures of quantization, which tests of several packages share."""

from _quantized import drift, operators, quantized

__all__ = ["drift", "operators", "quantized"]
