"""What a graph says: ONNX Runtime on the CPU, which computes each operator as it is written.

No engine to run a robot on, but the one that others are held against: an engine that rewrites a graph may compute other
numbers than the graph says, and an answer of its own would not show it.
"""

from __future__ import annotations

from vlatool.runtime.engines.ort_cpu import OrtCpuSession


class ReferenceSession(OrtCpuSession):
    """One ONNX file open in ONNX Runtime on the CPU with all rewriting of the graph off."""

    optimized = False
