"""Whether integer products are exact on this machine, or saturate: asked of an engine by a product that would.

x86 without VNNI multiplies uint8 with int8 in pairs and adds both products in 16 bits. Two times 255 x 127 is 64,770
and becomes 32,767: an int8 policy computes other actions there, in silence. ONNX Runtime has an option that is exact on
such processors, for uint8 activations and at a cost; int8 activations are exact without it.
"""

from __future__ import annotations

import base64
import functools
import zlib
from typing import Any

import numpy as np

MODEL = (
    "eNrtlD0OgkAQRneA6DIqGZfaQuw4go2EWBEpbO1QtiAxIIQfoZEDeECPI9JhvIG8ZJpvXv24Ltj2peMa4Y5qEkvUGpklAlLLOBZBnEeN"
    "PESxDDLcIKQDJbRoL9OhtEKoeklA+eO9RAgRSgG1NfGD3C+uYnrLkrC45PaTc4cTqS5UXssfIyMjf4u9IHA/IfE0xtqdPSPF7bvjATuZ"
    "Xa2EgXMOgqPCqTvn3I3110iuhozMN+NnLrw="
)
"""An ONNX model, compressed: float32 ``x`` (16, 64), quantized to uint8 in steps of 1, times int8 weights (64, 16) that
are all 127, as ``y``."""
SHAPE = (16, 64)
WANTED = 255.0 * 127 * SHAPE[1]
PRECISE = ("session.x64quantprecision", "1")
"""The option of ONNX Runtime (``onnxruntime_session_options_config_keys.h``)."""
EXACT = "exact"
EXACT_BY_OPTION = f"exact with {PRECISE[0]}={PRECISE[1]}, which is set; slower than on a processor with VNNI"
SATURATING = "saturating: this processor adds pairs of int8 products in 16 bits"


def model() -> bytes:
    """Return the product as a serialized ``ModelProto``."""
    return zlib.decompress(base64.b64decode(MODEL))


def operand() -> Any:
    """Return the value of its input, with which every element of the product is ``WANTED``."""
    return np.full(SHAPE, 255, np.float32)


@functools.lru_cache(maxsize=4)
def ort_product(ort: Any, precise: bool = False) -> float:
    """Return the smallest element of the product in ONNX Runtime; it is asked once in each process.

    Args:
        ort: The module.
        precise: With the option that makes it exact.
    """
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    if precise:
        options.add_session_config_entry(*PRECISE)
    session = ort.InferenceSession(model(), options, providers=["CPUExecutionProvider"])
    return float(session.run(None, {"x": operand()})[0].min())
