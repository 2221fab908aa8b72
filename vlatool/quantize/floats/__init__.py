"""Rewrites of ONNX graphs for float16 and float8, and what these types lose."""
