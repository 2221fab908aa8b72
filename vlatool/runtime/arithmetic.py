"""Whether integer products are exact on this machine, or saturate: asked of an engine by a product that would.

x86 without VNNI multiplies uint8 with int8 in pairs and adds both products in 16 bits. Two times 255 x 127 is 64,770
and becomes 32,767: an int8 policy silently computes other actions there. ONNX Runtime has an option that is exact on
such processors, for uint8 activations and at a cost; int8 activations are exact without it. The option is a rewriting
of the graph (of its weights to uint8), so that a session that rewrites nothing saturates regardless.
"""

from __future__ import annotations

import binascii
import functools
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.manifest import Manifest
from vlatool.runtime.engine import UNKNOWN as UNKNOWN
from vlatool.runtime.engine import engine_class
from vlatool.runtime.stored_types import lacks_zero_point

MODEL = (
    "eNrj4BRisHrNyaXIxVjBxZyfl8rFUpValC/EWKjEF1iamFeSWZXqk5mXmljEpczFWIiiJEVJwCW1EENROVRRHpAUYizDokiQizGFi7FMiLFSic03"
    "scS3NEeIvaAoP6U0uUSrh4PDgUNAgNmJsdyrgaN+FIyCUTBigRavAKMTqDjxYmFgaLDX4hZgcgKXPl6MDEAOsxO4lAFyooSBBZgQHxcPB6MQBxcT"
    "hwAQOyQBBSvRBAWcWLgYBIQBrr4zHA=="
)
"""An ONNX model, compressed: float32 ``x`` (16, 64), quantized to uint8 in steps of 1, times int8 weights (64, 16) that
are all 127, as ``y``."""
INTEGER_MODEL = (
    "eNrtlD0OgkAUhBkk8fH8yboWWhgLSo5gI8FKooWtHSQbs4nBCEsQGjmAh/Acns6tvYJ8ySSTb/ohf/PxecV4MEpGK3EPpqcqzY1u1UHnKi14zbgz"
    "arsyMgkdTI6pOVbXfW7URRW8YGiJJvB2aWlCn11zW+INVw7rQhuj8vBFFJEQgxh10tGzp6fnbwlHAjHKxHOcbhuScGO0CRzb7EFktp3n9o/klMcE"
    "SeySsIkyK5sfKWKPHTH7AsvUIAM="
)
"""The same product, written as an integer operator (MatMulInteger), not as pairs around a float one. In both, the
weights have a zero point, without which ONNX Runtime up to 1.29 aborts with ``PRECISE_OPTION`` (``breaks_precise``)."""
SHAPE = (16, 64)
EXACT_SUM = 255.0 * 127 * SHAPE[1]
PRECISE_OPTION = ("session.x64quantprecision", "1")
"""The option of ONNX Runtime (``onnxruntime_session_options_config_keys.h``)."""
SIGNED_OPTION = ("session.qdqisint8allowed", "1")
"""The option of ONNX Runtime that leaves int8 activations of quantize/dequantize pairs int8: on x86 it rewrites them to
uint8 otherwise, with which convolutions saturate where those of int8 are exact."""
UNFUSED_OPTION = ("session.disable_quant_qdq", "1")
"""The option of ONNX Runtime that leaves quantize/dequantize pairs what they say: float products of rounded values."""
SETS_ZERO_POINTS = (1, 30)
"""Release of ONNX Runtime from which on ``PRECISE_OPTION`` adds a zero point where a node has none."""
EXACT = "exact"
EXACT_BY_OPTION = (
    f"exact with {PRECISE_OPTION[0]}={PRECISE_OPTION[1]}, which is set; slower than on a processor with VNNI"
)
SATURATING = "saturating: they are added in pairs of 16 bits"


def model(written: bool = False) -> bytes:
    """Return the product, or the one that is written as an integer operator, as a serialized ``ModelProto``."""
    return zlib.decompress(binascii.a2b_base64(INTEGER_MODEL if written else MODEL))


def operand() -> Any:
    """Return the value of its input, with which every element of the product is ``EXACT_SUM``."""
    return np.full(SHAPE, 255, np.float32)


def breaks_precise(ort: Any, model: Path | bytes) -> bool:
    """Return whether ONNX Runtime would end the process where it opens a graph with the option ``PRECISE_OPTION``.

    Up to 1.29 that rewriting writes a zero point behind the end of a node's inputs where int8 weights have none: the
    library stops with an assertion of ``vector::operator[]``.
    """
    release = str(getattr(ort, "__version__", "")).split(".")[:2]
    if not all(part.isdigit() for part in release) or tuple(map(int, release)) >= SETS_ZERO_POINTS:
        return False
    return lacks_zero_point(model)


@functools.lru_cache(maxsize=4)
def ort_product(ort: Any, precise: bool = False, written: bool = False) -> float:
    """Return the smallest element of the product in ONNX Runtime, NaN when it fails; asked once in each process.

    Args:
        written: Of the integer operator, in a session that rewrites as little of a graph as it can.
    """
    try:
        options = ort.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = 1
        if written:
            as_written(ort, options, precise)
        elif precise:
            options.add_session_config_entry(*PRECISE_OPTION)
        session = ort.InferenceSession(model(written), options, providers=["CPUExecutionProvider"])
        return float(session.run(None, {"x": operand()})[0].min())
    except Exception:  # the seam: a build without these operators still runs float32
        return math.nan


def ort_exactness(ort: Any, written: bool = False) -> str:
    """Return whether integer products are exact in ONNX Runtime on this machine, or saturate; see ``ort_product``."""
    plain = exactness(ort_product(ort, written=written))
    if plain != SATURATING:
        return plain
    return EXACT_BY_OPTION if ort_product(ort, precise=True, written=written) == EXACT_SUM else plain


def exactness(product: float) -> str:
    """Return what a smallest element of the product means."""
    if math.isnan(product):
        return UNKNOWN
    return EXACT if product == EXACT_SUM else SATURATING


def as_written(ort: Any, options: Any, precise: bool) -> None:
    """Set the options of a session that is to compute the operators of a graph as they are written.

    Args:
        precise: Rewrite weights, so that integer products are exact: that takes the second level of rewriting, whose
            other parts merge float operators. The one that would make integer products of pairs stays off.
    """
    levels = ort.GraphOptimizationLevel
    options.graph_optimization_level = levels.ORT_ENABLE_EXTENDED if precise else levels.ORT_DISABLE_ALL
    for entry in (PRECISE_OPTION, UNFUSED_OPTION) if precise else ():
        options.add_session_config_entry(*entry)


def is_int8(manifest: Manifest) -> bool:
    """Return whether a graph of a bundle has int8 products."""
    return any("int8" in graph.precision for graph in manifest.graphs.values())


def int8_trouble(manifest: Manifest, engine: str) -> tuple[str, str]:
    """Return how an engine computes the int8 products of a bundle on this machine, and what to do about it.

    Returns:
        A sentence and a remedy; both are empty where the bundle has no such products, and where they are exact.

    Raises:
        MissingExtra: when the engine is not installed.
    """
    if not is_int8(manifest):
        return "", ""
    library = engine_class(engine)
    products = str(library.arithmetic())
    if products == EXACT:
        return "", ""
    return f"Its int8 products are {products}.", library.remedy if products == SATURATING else ""


def machine(engine: str) -> str:
    """Return what an engine computes on: this "machine", and where the engine is confined on it, what to."""
    from vlatool.machine.host import (  # only where there is something to say: it takes its time
        MAX_CPU_ISA,
        onednn_max_cpu_isa,
    )

    library = engine_class(engine)
    confined = onednn_max_cpu_isa() if library.confined else None
    return f"machine ({library.title} confined to {confined} by {MAX_CPU_ISA})" if confined else "machine"
