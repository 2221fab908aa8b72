"""Rewrites of ONNX graphs for int8: fewer and cheaper operators around the quantized products."""
