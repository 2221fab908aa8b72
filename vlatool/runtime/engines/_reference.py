"""What a graph says: ONNX Runtime on the CPU, which computes each operator as it is written.

Not an engine to run a robot on, but the one that others are compared with: an engine that rewrites a graph may compute
other numbers than the graph says, and its own answer would not show it.

Where integer operators saturate, they do so in a session that rewrites nothing, too, and a saturated answer is not what
the graph says. There the option that makes them exact is set, with the rewriting that it takes and no more
(``arithmetic.as_written``), and the product is asked again: an option is not believed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlatool.errors import require
from vlatool.runtime import arithmetic
from vlatool.runtime.engines._onnx_runtime import is_true_of, open_session, session_options, traced_into
from vlatool.runtime.engines.ort_cpu import OrtCpuSession


class ReferenceSession(OrtCpuSession):
    """One ONNX file open in ONNX Runtime on the CPU, with rewriting of the graph off as far as products are exact."""

    @staticmethod
    def _option_sets(ort: Any, model: Path | bytes, threads: int | None) -> list[Any]:
        """Return the options to try: signed activations, which are exact anyway, are refused by the exact products."""
        exact_by_option = arithmetic.ort_exactness(ort, written=True) == arithmetic.EXACT_BY_OPTION
        exact_by_option = exact_by_option and not is_true_of(arithmetic.breaks_precise, ort, model)
        option_sets = []
        for precise in [True, False] if exact_by_option else [False]:
            option_sets.append(session_options(ort, threads))
            arithmetic.as_written(ort, option_sets[-1], precise)
        return option_sets

    @staticmethod
    def arithmetic() -> str:
        """Return whether the reference's integer products are exact here; raises MissingExtra without onnxruntime."""
        return arithmetic.ort_exactness(require("onnxruntime", "ort"), written=True)


class BranchesSession(OrtCpuSession):
    """One ONNX file whose quantize/dequantize pairs are in the branches of ``If``, open in ONNX Runtime on the CPU.

    Where int8 products saturate, the option that makes them exact rewrites weights, but none that a branch reads from
    the graph around it (1.32): fused products would silently saturate there. Pairs that stay pairs are float products
    of rounded values, which are exact.
    """

    @classmethod
    def _open(
        cls, ort: Any, model: Path | bytes, threads: int | None, trace: str | None = None, providers: Any = None
    ) -> Any:
        if arithmetic.ort_product(ort) >= arithmetic.EXACT_SUM:
            return super()._open(ort, model, threads, trace, providers)
        options = traced_into(trace, session_options(ort, threads))
        options.add_session_config_entry(*arithmetic.UNFUSED_OPTION)
        return open_session(ort, model, options)
