"""What this machine computes: asked of the product's own probe and of the processor's flags, once in a process.

A test expects what is found here, and so holds on every processor. Where a claim itself needs an instruction, the test
is marked: ``@pytest.mark.needs("exact openvino", reason="...")``; ``pytest -rs`` lists what was left out, and why.
"""

from __future__ import annotations

import functools
import importlib.util
import os
from collections.abc import Callable

import numpy as np

from vlatool.machine.host import MAX_CPU_ISA, VNNI, isa
from vlatool.machine.instruction_sets import RUNGS, SATURATING, openvino_set, rung
from vlatool.runtime.arithmetic import EXACT
from vlatool.runtime.engine import UNKNOWN, engine_class


@functools.cache
def products(engine: str) -> str:
    """Return what an engine says of its int8 products on this machine; ask before a test replaces its probe."""
    return str(engine_class(engine).arithmetic())


def exact(engine: str = "ort_cpu") -> bool:
    """Whether an engine's int8 products are exact here, by an option of its own or without one."""
    return products(engine).startswith("exact")


def full_range_or_less() -> dict[str, bool]:
    """Return the options of static int8 with which OpenVINO's products are exact on this processor."""
    return {} if exact("openvino") else {"reduce_range": True}


def weights_of_this_host(engine: str = "ort_cpu") -> dict[str, bool]:
    """Return the options that the command line gives to int8 for an engine of this host, where none are typed."""
    return {} if products(engine) in (EXACT, UNKNOWN) else {"reduce_range": True}


@functools.cache
def computes_bfloat16() -> bool:
    """Whether OpenVINO computes in bfloat16 here; with AVX512 it does without listing it, by float32's instructions."""
    import openvino
    from openvino import opset13 as ops

    given = ops.parameter([1, 4], np.float32)
    asked = {"INFERENCE_PRECISION_HINT": "bf16"}
    made = openvino.Core().compile_model(openvino.Model([ops.relu(given)], [given]), "CPU", asked)
    return str(made.get_property("INFERENCE_PRECISION_HINT").get_type_name()) == "bf16"


def host_set() -> str:
    """Return the highest instruction set of this processor; empty when it is no x86 with AVX2."""
    return rung(isa() or ())


def _openvino() -> bool:
    return importlib.util.find_spec("openvino") is not None


def _confinable(feature: str) -> bool:
    """Whether OpenVINO can be confined to the set with this feature in a child of this process."""
    return _openvino() and feature in (isa() or ()) and MAX_CPU_ISA not in os.environ


NEEDS: dict[str, Callable[[], bool]] = {
    "vnni": lambda: any(feature in (isa() or ()) for feature in VNNI),
    "more than avx2": lambda: host_set() not in ("", *SATURATING) and MAX_CPU_ISA not in os.environ,
    "exact openvino": lambda: _openvino() and exact("openvino"),
    "exact onnxruntime": lambda: exact("ort_cpu"),
    "bfloat16": lambda: _openvino() and computes_bfloat16(),
    **{name: functools.partial(_confinable, feature) for name, feature in RUNGS.items()},
}
"""Word of the marker -> whether this machine has it."""


def lacks(need: str, reason: str) -> str:
    """Return why a test that needs this is skipped here; empty where it runs.

    Raises:
        KeyError: when the word is none of ``NEEDS``.
    """
    if NEEDS[need]():
        return ""
    return f"needs {need}, and OpenVINO computes in {openvino_set() or 'no x86 set'} here: {reason}"
