"""ONNX Runtime for a graph whose quantize/dequantize pairs are in the branches of ``If``.

Where int8 products saturate, the option that makes them exact rewrites weights, but none that a branch reads from the
graph around it (1.32): fused products would silently saturate there. Pairs that stay pairs are float products of
rounded values, which are exact.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlatool.runtime import arithmetic
from vlatool.runtime.engines._onnx_runtime import open_session, session_options
from vlatool.runtime.engines.ort_cpu import OrtCpuSession


class BranchesSession(OrtCpuSession):
    """One ONNX file open in ONNX Runtime on the CPU; where products saturate, pairs are computed as written."""

    @classmethod
    def _open(cls, ort: Any, model: Path | bytes, threads: int | None) -> Any:
        if arithmetic.ort_product(ort) >= arithmetic.EXACT_SUM:
            return super()._open(ort, model, threads)
        options = session_options(ort, threads)
        options.add_session_config_entry(*arithmetic.UNFUSED_OPTION)
        return open_session(ort, model, options)
