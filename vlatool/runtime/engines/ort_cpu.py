"""ONNX Runtime on the CPU."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.errors import require
from vlatool.machine.host import VNNI
from vlatool.runtime import arithmetic
from vlatool.runtime.engine import Int8Layout, Node, Stages
from vlatool.runtime.engines._onnx_runtime import ON_CPU, OnnxRuntimeSession, is_true_of, session_options

if TYPE_CHECKING:
    from vlatool.machine.target import Target

IGNORED_PROVIDERS = ("AzureExecutionProvider",)
"""ONNX Runtime lists it beside the processor in every build; it runs nothing on this machine."""
X86 = ("x86_64", "AMD64")
SIGNED_PRODUCT = "int8 x int8 on x86: ONNX Runtime's fast kernel takes uint8 x int8 (activations: uint8)"
INT8_VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "": {}, "_mse": {"method": "mse"}, "_attention": {"attention": True}, "_elementwise": {"elementwise": True},
}  # fmt: skip
"""Ending of a plan's name -> options of static int8 that a search begins with, and combines."""


def _fit(model: Path | bytes) -> bool:
    """Return whether the weights of a graph cannot saturate; asked where integer products may."""
    from vlatool.runtime.weight_pairs import weights_fit

    return is_true_of(weights_fit, model)


class OrtCpuSession(OnnxRuntimeSession):
    """One ONNX file open in ONNX Runtime on the CPU."""

    title = "ONNX Runtime"
    substitutes = ("onnxruntime-gpu", "onnxruntime-openvino")
    searched = True
    layouts: ClassVar[Mapping[str, Int8Layout]] = {"ort": Int8Layout(integer=True)}
    int8: ClassVar[Mapping[str, Any]] = {}
    remedy = "quantize again with --reduce-range, or with --activations int8"
    providers = ON_CPU

    @staticmethod
    def _option_sets(ort: Any, model: Path | bytes, threads: int | None) -> list[Any]:
        """Return the options to try, one after the other.

        Exact products of uint8 activations refuse a graph with int8 ones, which are exact as long as they stay int8.
        Weights that cannot saturate need no such option, which would make them slower. And ONNX Runtime (1.31) takes
        float8 pairs around a MatMul for int8 ones and writes an integer product that has no such type. Where exact
        products would end the process, pairs are computed in float, which is exact, too.
        """
        entries: list[tuple[str, str] | None] = [None]
        if arithmetic.ort_product(ort) < arithmetic.EXACT_SUM and not _fit(model):
            breaks = is_true_of(arithmetic.breaks_precise, ort, model)
            entries = [] if breaks else [arithmetic.PRECISE_OPTION, arithmetic.SIGNED_OPTION]
        option_sets = []
        for entry in (*entries, arithmetic.UNFUSED_OPTION):
            option_sets.append(session_options(ort, threads))
            if entry is not None:
                option_sets[-1].add_session_config_entry(*entry)
        return option_sets

    @staticmethod
    def arithmetic() -> str:
        """Return whether integer products are exact here, or saturate; raises MissingExtra without onnxruntime."""
        return arithmetic.ort_exactness(require("onnxruntime", "ort"))

    @classmethod
    def execution_providers(cls) -> list[str]:
        """Return the execution providers of the installed library, without those that run nothing on this machine.

        Raises:
            MissingExtra: when onnxruntime cannot be imported.
        """
        return [str(name) for name in cls.onnxruntime().get_available_providers() if name not in IGNORED_PROVIDERS]

    @classmethod
    def variants(cls, target: Target, calibrated: bool) -> dict[str, Stages]:
        """Return int8 at run time, and with ranges from a recording: plain, by their error, attention too.

        Where int8 products saturate, weights are such that none does; all 8 bits, which take an exact mode, are one
        more plan.
        """
        saturates = target.has("avx2") and not target.has(*VNNI)
        weights = {"reduce_range": True} if saturates else {}
        plans: dict[str, Stages] = {"dynamic_int8": ({"quantize.dynamic_int8": dict(weights)},)}
        for name, options in INT8_VARIANTS.items() if calibrated else ():
            plans[f"static_int8{name}"] = ({"quantize.static_int8": {**weights, **options}},)
        if calibrated and saturates:
            plans["static_int8_all_bits"] = ({"quantize.static_int8": {"reduce_range": False}},)
        return plans

    @classmethod
    def slow(cls, node: Node, computed: str, product: bool, zero_points: int) -> str:
        """Name products of two signed operands, for which x86 has no fast instruction before AVX-VNNI-INT8."""
        _, kind, dtypes = node
        signed = kind.startswith(("MatMulInteger", "QLinearMatMul", "QGemm")) and dtypes.startswith("int8")
        return SIGNED_PRODUCT if signed and platform.machine() in X86 else ""
