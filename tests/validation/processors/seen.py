"""What the libraries of an environment see of the processor: run by the environment's own Python, after confining.

Usage: python -I tests/validation/processors/seen.py [PROBE.so]

Prints one line of JSON: library -> feature (as in ``/proc/cpuinfo``) -> whether it sees it. A library that is not
installed is absent; one that cannot be asked says so as an ``error``.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # -I leaves it out

from _cpuinfo import CPUINFO, flags
from _sets import ANY, BFLOAT16, BITS, EXACT_INT8, FEATURES, REGISTERS

Seen = dict[str, bool]
LEVELS = {"DEFAULT": (), "AVX2": ("avx2",), "AVX512": ("avx2", "avx512f")}
"""``torch.backends.cpu.get_cpu_capability()`` -> what its kernels are compiled for."""
CAPABILITIES = {"WINOGRAD": "avx512f", "BF16": BFLOAT16, "FP16": "avx512_fp16"}
"""What OpenVINO's processor plugin offers -> the feature that it offers it for."""


def main() -> None:
    """Ask every library that is here."""
    asked: dict[str, tuple[str, Callable[[], Seen]]] = {
        "numpy": ("numpy", numpy),
        "torch": ("torch", torch),
        "ONNX Runtime": ("onnxruntime", onnxruntime),
        "OpenVINO": ("openvino", openvino),
        "vlatool": ("vlatool", vlatool),
    }
    seen: dict[str, Mapping[str, bool | str]] = {"/proc/cpuinfo": of_names(flags(CPUINFO.read_text()))}
    for path in sys.argv[1:]:
        seen["CPUID"] = probe(path)
    for name, (module, ask) in asked.items():
        if importlib.util.find_spec(module) is not None:
            seen[name] = answered(ask)
    print(json.dumps(seen))


def answered(ask: Callable[[], Seen]) -> Mapping[str, bool | str]:
    """Return what a library sees, or why it cannot be asked."""
    try:
        return ask()
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}"}


def of_names(names: Iterable[str]) -> Seen:
    """Return which features are among names that libraries spell in their own ways: AVX512F, avx512_f, fma3."""
    plain = {name.lower().replace("_", "").replace("fma3", "fma") for name in names}
    return {feature: feature.replace("_", "") in plain for feature in FEATURES}


def known(states: Mapping[str, object]) -> Seen:
    """Return the features that a library knows of, by its own spelling."""
    true, both = of_names(name for name, state in states.items() if state is True), of_names(states)
    return {feature: true[feature] for feature in FEATURES if both[feature]}


def probe(path: str) -> Seen:
    """Ask CPUID itself, in a library that was confined as all others were."""
    library, found = ctypes.CDLL(path), (ctypes.c_uint * 4)()
    seen = {}
    for (leaf, subleaf, register), bits in BITS.items():
        library.ask(ctypes.c_uint(leaf), ctypes.c_uint(0 if subleaf == ANY else subleaf), found)
        word = found[REGISTERS.index(register)]
        seen.update({feature: bool(word >> bit & 1) for feature, bit in bits.items()})
    return seen


def numpy() -> Seen:
    """Ask numpy for the features that it dispatches on."""
    try:
        from numpy._core._multiarray_umath import __cpu_features__
    except ImportError:  # numpy 1
        from numpy.core._multiarray_umath import __cpu_features__
    return known(__cpu_features__)


def torch() -> Seen:
    """Ask torch which kernels it takes, and its library cpuinfo."""
    import torch as library

    level = LEVELS[library.backends.cpu.get_cpu_capability().partition(" ")[0]]
    seen = {feature: feature in level for feature in ("avx2", "avx512f")}
    if hasattr(library.cpu, "get_capabilities"):
        more = known(library.cpu.get_capabilities())
        seen.update({feature: state or seen.get(feature, False) for feature, state in more.items()})
    return seen


def onnxruntime() -> Seen:
    """Ask ONNX Runtime by a product that saturates without VNNI."""
    import onnxruntime as library

    from vlatool.runtime.arithmetic import EXACT_SUM, ort_product

    return {EXACT_INT8: ort_product(library) == EXACT_SUM}


def openvino() -> Seen:
    """Ask OpenVINO's processor plugin what it is capable of."""
    import openvino as library

    offered = library.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return {feature: capability in offered for capability, feature in CAPABILITIES.items()}


def vlatool() -> Seen:
    """Ask vlatool's fingerprint of the machine."""
    from vlatool.machine.host import ISA_FEATURES, isa

    has = isa() or ()
    return {feature: feature in has for feature in ISA_FEATURES if feature in FEATURES}


if __name__ == "__main__":
    main()
