"""The instruction set of a board, and whether OpenVINO on this host can be confined to it.

oneDNN, which computes for OpenVINO on x86, takes no instructions beyond ``ONEDNN_MAX_CPU_ISA``; it reads the variable
once, when it is loaded. A name above what the processor has is taken in silence for what it has below: whether it has
the set is asked of the processor (``/proc/cpuinfo``), never of oneDNN. ONNX Runtime has no such switch.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vlatool.machine.host import fingerprint, isa, matches, onednn_max_cpu_isa

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

RUNGS = {
    "AVX512_CORE_AMX": "amx_int8",
    "AVX512_CORE_BF16": "avx512_bf16",
    "AVX512_CORE_VNNI": "avx512_vnni",
    "AVX512_CORE": "avx512f",
    "AVX2_VNNI_2": "avx_vnni_int8",
    "AVX2_VNNI": "avx_vnni",
    "AVX2": "avx2",
}
"""oneDNN's name of a set -> the feature that it has and those below it lack, the highest first. Every AVX512 set holds
AVX2, but not AVX2_VNNI: AVX512-VNNI and AVX-VNNI are instructions of their own."""
SATURATING = ("AVX512_CORE", "AVX2")
"""Sets without VNNI: int8 products are added in pairs of 16 bits."""
ENGINE = "openvino"


@dataclass(frozen=True)
class BoardSet:
    """The set that OpenVINO computes in on a board, beside the one that it computes in here.

    Args:
        wanted: the board's set; empty where there is nothing to compare (no profile, no x86, no OpenVINO on it).
        lacks: the feature that this host's processor would need for it; empty when it has it.
        host: the highest set of this host's processor; empty when it is not an x86.
        isa_limit: what OpenVINO obeys of ``ONEDNN_MAX_CPU_ISA`` in this process; empty when it confines nothing.
    """

    board: str = ""
    wanted: str = ""
    lacks: str = ""
    host: str = ""
    isa_limit: str = ""

    @property
    def to_set(self) -> str:
        """What the variable must say in a further process; empty where it is not needed or not useful."""
        needed = self.wanted and not self.lacks and not self.isa_limit and self.host != self.wanted
        return self.wanted if needed else ""

    @property
    def is_confined(self) -> bool:
        """Whether OpenVINO computes in the board's set in this process, and ONNX Runtime in the host's own."""
        return bool(self.wanted) and not self.lacks and self.isa_limit == self.wanted != self.host

    @property
    def same_set(self) -> bool:
        """Whether everything computes in the board's set: it is this host's."""
        return bool(self.wanted) and self.host == self.wanted and self.isa_limit in ("", self.wanted)

    @property
    def saturates(self) -> bool:
        """Whether the board has no VNNI, so that int8 may saturate and may be slower than float32."""
        return self.wanted in SATURATING

    @property
    def where(self) -> str:
        """Where confined figures were measured: a place of its own beside ``this host``."""
        return f"this host, OpenVINO confined to {self.wanted}"

    @property
    def ratio(self) -> str:
        """What a ratio within OpenVINO is one of."""
        return f"the instruction set of {self.board} ({self.wanted}), on another core"

    def plan(self) -> str:
        """Say before the run what OpenVINO will compute in; empty where there is nothing to say."""
        if not self.wanted:
            return ""
        if self.to_set or self.is_confined:
            return f"OpenVINO confined to {self.wanted}, in a process of its own; ONNX Runtime as this host is"
        if self.same_set:
            return f"OpenVINO in {self.wanted}, as this host is"
        return f"OpenVINO in {self.isa_limit or self.host or 'what this host has'}; {self.board} has {self.wanted}"

    def sentences(self) -> tuple[str, ...]:
        """Say what the figures of OpenVINO are those of, where that is the board's set."""
        if self.same_set:
            return (f"This host has the instruction set of {self.board} ({self.wanted}) on another core: errors and "
                    "ratios are of that set, milliseconds are this host's.",)  # fmt: skip
        if not self.is_confined:
            return ()
        return (
            f"OpenVINO was confined to {self.wanted}, the instruction set of {self.board}: its errors are of that set, "
            "and its speed-ups are against float32 in OpenVINO, of the same instruction set on another core; its "
            "milliseconds are not the board's.",
            f"ONNX Runtime cannot be confined, so that its figures are of this host's own set ({self.host}), and no "
            f"ratio between the two engines is given.{self._gains_less()}",
        )

    def about_errors(self) -> tuple[str, ...]:
        """Say what errors alone are those of, where OpenVINO is or can be confined to the board's set."""
        if self.is_confined or self.to_set:
            sentence = f"OpenVINO was confined to {self.wanted}, the instruction set of {self.board}"
            return (f"{sentence}: its answers are of that set.",)
        return (f"This host has the instruction set of {self.board} ({self.wanted}).",) if self.same_set else ()

    def warnings(self) -> tuple[str, ...]:
        """Say where this host's figures are not those of the board's set, what that means, and what to do."""
        if not self.wanted or self.is_confined or self.same_set:
            return ()
        if self.isa_limit:
            return (f"ONEDNN_MAX_CPU_ISA={self.isa_limit} is set, so that OpenVINO computes neither as {self.board} "
                    f"({self.wanted}) nor as this host can: unset it.",)  # fmt: skip
        if self.to_set:
            return ()
        here = self.host or "another architecture"
        beyond = f"OpenVINO cannot be confined to {self.wanted}, the instruction set of {self.board}, on this host"
        why = f"its processor has no {self.lacks}, and oneDNN would take an older set in silence"
        return (f"{beyond}: {why}. Every figure of OpenVINO here is of this host's set ({here}): {self._nearest()} "
                f"Measure on {self.board}, or on a processor with {self.lacks}.",)  # fmt: skip

    def _gains_less(self) -> str:
        """Say what VNNI here does to the figures of ONNX Runtime, where the board has none."""
        if not self.saturates or self.host in SATURATING:
            return ""
        return " It has VNNI and the board has none: int8 gains less in ONNX Runtime there, or loses."

    def _nearest(self) -> str:
        """Say what the figures of this host's own set are worth."""
        speed = "speed-ups are not those of the board, and its set may order the plans otherwise."
        if not self.host:
            return f"errors may differ, and {speed}"
        if (self.host in SATURATING) == self.saturates:
            same = "may saturate" if self.saturates else "are exact"
            return f"int8 products {same} in both, so that errors are the nearest that can be had; {speed}"
        there, own = ("may saturate", "are exact") if self.saturates else ("are exact", "may saturate")
        return f"int8 products {there} on the board and {own} here, so that errors do not carry over; {speed}"


def rung(features: Collection[str]) -> str:
    """Return the highest set that has these features (names of ``/proc/cpuinfo``); empty without x86 and AVX2.

    Example:
        >>> rung(["avx2", "fma", "avx_vnni"])
        'AVX2_VNNI'
    """
    return next((name for name, feature in RUNGS.items() if feature in features), "")


def saturates(features: Collection[str]) -> bool:
    """Return whether a processor with these features adds int8 products in pairs of 16 bits: x86 with AVX2, no VNNI.

    Example:
        >>> saturates(["avx2", "fma"]), saturates(["avx2", "avx_vnni"]), saturates(["asimd"])
        (True, False, False)
    """
    return rung(features) in SATURATING


def effective_set(isa_limit: str, host: Collection[str]) -> str:
    """Return the set that oneDNN computes in under a value of ``ONEDNN_MAX_CPU_ISA``, on a processor with features.

    A set that the processor lacks is taken for the highest below it; a name that is none of ``RUNGS`` stands as it is.

    Example:
        >>> effective_set("AVX512_CORE_AMX", ["avx2", "avx_vnni"])
        'AVX2_VNNI'
    """
    names = list(RUNGS)
    below = names[names.index(isa_limit) :] if isa_limit in RUNGS else []
    return next((name for name in below if RUNGS[name] in host), isa_limit)


def compare_sets(board: str, features: Collection[str], host: Collection[str], isa_limit: str = "") -> BoardSet:
    """Return a board's set beside this host's.

    Args:
        features: features of the board's processor.
        host: features of this host's processor.
        isa_limit: what ``ONEDNN_MAX_CPU_ISA`` says.
    """
    wanted = rung(features)
    needed, own, isa_limit = RUNGS.get(wanted, ""), rung(host), effective_set(isa_limit, host)
    return BoardSet(board, wanted, "" if needed in host else needed, own, "" if isa_limit == own else isa_limit)


def board_set(profile: Profile | None) -> BoardSet:
    """Return the set that OpenVINO needs to compute in as a profile's board does, beside this host's.

    It is empty without a profile, on the board itself, and where the board or this host has no OpenVINO.
    """
    if profile is None or ENGINE not in profile.engines or importlib.util.find_spec(ENGINE) is None:
        return BoardSet()
    if matches(profile.model_strings, fingerprint()):
        return BoardSet()
    features = profile.units[profile.engines[ENGINE].unit].isa
    return compare_sets(profile.name, features, isa() or (), onednn_max_cpu_isa() or "")


def about_onnx_runtime(profile: Profile | None) -> tuple[str, ...]:
    """Say of an x86 board without VNNI that runs ONNX Runtime alone that int8 may lose there; else nothing."""
    if profile is None or profile.engine != "ort_cpu" or ENGINE in profile.engines:
        return ()
    if rung(profile.units[profile.engines["ort_cpu"].unit].isa) not in SATURATING:
        return ()
    host = rung(isa() or ())
    first = f"{profile.name} has no VNNI: int8 may be slower than float32 there."
    if host in ("", *SATURATING):
        return (first,)
    return (f"{first} It was timed in this host's own set ({host}), which has it: its speed-ups do not carry over.",)


def openvino_set() -> str:
    """Return what OpenVINO computes in, in this process: what it is confined to, or the processor's highest set."""
    host = isa() or ()
    return effective_set(onednn_max_cpu_isa() or "", host) or rung(host)
