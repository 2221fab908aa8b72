"""Instruction sets that this host can be restricted to, and what it needs to have for that."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from _cpuinfo import CPUINFO as CPUINFO
from _cpuinfo import flags

from vlatool.machine.host import MAX_CPU_ISA

AVX512 = ("avx512f", "avx512bw", "avx512dq", "avx512vl")


@dataclass(frozen=True)
class Rung:
    """A restriction. oneDNN passes over what a processor lacks in silence, and takes the next lower set.

    Args:
        name: What the table calls it.
        engine: The engine that it restricts.
        needs: Flags of ``/proc/cpuinfo`` without which it would be another one.
        isa: Value of the variable; empty when it is not set.
        cpu: Processor that QEMU emulates; empty when it runs on the host itself.
    """

    name: str
    engine: str
    needs: tuple[str, ...] = ()
    isa: str = ""
    cpu: str = ""

    def lacking(self, flags: Collection[str]) -> tuple[str, ...]:
        """Return what a processor with these flags lacks for it."""
        return tuple(flag for flag in self.needs if flag not in flags)

    @property
    def variables(self) -> dict[str, str]:
        """Variables of the environment."""
        return {MAX_CPU_ISA: self.isa} if self.isa else {}


RUNGS = (
    Rung("host", "ort_cpu"),
    Rung("Haswell in QEMU (AVX2)", "ort_cpu", cpu="Haswell"),
    Rung("host", "openvino"),
    Rung("AVX512_CORE_VNNI", "openvino", (*AVX512, "avx512_vnni"), "AVX512_CORE_VNNI"),
    Rung("AVX512_CORE", "openvino", AVX512, "AVX512_CORE"),
    Rung("AVX2_VNNI", "openvino", ("avx2", "avx_vnni"), "AVX2_VNNI"),
    Rung("AVX2", "openvino", ("avx2",), "AVX2"),
)
"""ONNX Runtime's kernels have no such variable, so that one of its rungs is emulated."""


def model(text: str) -> str:
    """Return the name of the processor in a ``/proc/cpuinfo``, with what it has for int8."""
    found = re.search(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
    wanted = ("amx_int8", "avx512_vnni", "avx_vnni", "avx512_bf16", "avx512f", "avx2")
    has = [flag for flag in wanted if flag in flags(text)]
    name = found[1].strip() if found else "a processor without a name"
    return f"{name} ({', '.join(has) or 'without AVX2'})"
