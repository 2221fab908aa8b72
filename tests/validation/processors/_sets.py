"""Instruction sets that an environment can be confined to: what each keeps, and what a host needs to have for it.

Standard library alone, so that a set is refused before anything is installed. Features go by their names in
``/proc/cpuinfo``; where CPUID tells each of them is in Intel's manual (volume 2A, CPUID) and in ``cpufeatures.h`` of
Linux.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

REGISTERS = ("eax", "ebx", "ecx", "edx")
ANY = 0xFFFFFFFF
"""A leaf that has no subleaves: it is asked with anything in ECX."""
BITS = {
    (0x1, ANY, "ecx"): {"fma": 12, "avx": 28, "f16c": 29},
    (0x7, 0, "ebx"): {
        "avx2": 5,
        "avx512f": 16,
        "avx512dq": 17,
        "avx512ifma": 21,
        "avx512pf": 26,
        "avx512er": 27,
        "avx512cd": 28,
        "avx512bw": 30,
        "avx512vl": 31,
    },
    (0x7, 0, "ecx"): {
        "avx512vbmi": 1,
        "avx512_vbmi2": 6,
        "vaes": 9,
        "vpclmulqdq": 10,
        "avx512_vnni": 11,
        "avx512_bitalg": 12,
        "avx512_vpopcntdq": 14,
    },
    (0x7, 0, "edx"): {
        "avx512_4vnniw": 2,
        "avx512_4fmaps": 3,
        "avx512_vp2intersect": 8,
        "avx512_fp16": 23,
        "amx_bf16": 22,
        "amx_tile": 24,
        "amx_int8": 25,
    },
    (0x7, 1, "eax"): {"avx_vnni": 4, "avx512_bf16": 5, "amx_fp16": 21, "avx_ifma": 23},
    (0x7, 1, "edx"): {"avx_vnni_int8": 4, "avx_ne_convert": 5, "amx_complex": 8, "avx_vnni_int16": 10, "avx10": 19},
    (0x80000001, ANY, "ecx"): {"xop": 11, "fma4": 16},
}
"""Leaf, subleaf and register of CPUID -> feature -> bit: every vector instruction beyond SSE4.2."""
FEATURES = tuple(feature for bits in BITS.values() for feature in bits)
EMPTIED = {0x1D: "amx_tile", 0x1E: "amx_tile", 0x24: "avx10"}
"""Leaf that describes a feature and reads as zeros where that is hidden -> the feature."""
CARRIED_OUT_BY = {"avx_vnni": ("avx512_vnni", "avx512vl")}
"""Feature that a host need not have -> features that carry its instructions out, one by one (``avx_vnni.h``)."""
EXACT_INT8 = "exact int8 products"
BFLOAT16 = "bfloat16 in the processor"
"""What libraries tell of themselves without the name of a feature."""

OLD = ("ssse3", "sse4_1", "sse4_2", "popcnt")
"""What numpy's wheels cannot do without: no set is below it."""
AVX2 = ("avx", "f16c", "fma", "avx2")
AVX512 = (*AVX2, "avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl")
VAES = ("vaes", "vpclmulqdq")
ICE_LAKE = ("avx512ifma", "avx512vbmi", "avx512_vbmi2", "avx512_bitalg", "avx512_vpopcntdq")


class RefusedError(Exception):
    """What the user is told instead of a traceback."""


@dataclass(frozen=True)
class InstructionSet:
    """What an environment is confined to.

    Args:
        name: As the user calls it.
        needs: Features that a host must have, so that it is this set and not another below it.
        may: Features that are kept where the host has them; they change nothing in a network.
        like: A processor that has it.
    """

    name: str
    needs: tuple[str, ...]
    may: tuple[str, ...] = ()
    like: str = ""

    @property
    def hidden(self) -> frozenset[str]:
        """The features that no library may see."""
        return frozenset(FEATURES) - {*self.needs, *self.may}

    @property
    def vnni(self) -> bool:
        """Whether it has products of int8 that are exact; below AVX2 they are slower, and exact as well."""
        return bool({"avx_vnni", "avx512_vnni"} & {*self.needs})

    @property
    def expected(self) -> dict[str, bool]:
        """What a library of a confined environment may say: feature -> whether it sees it; others may be either."""
        told = {**dict.fromkeys(self.hidden, False), **dict.fromkeys(self.needs, True)}
        return {**told, BFLOAT16: False, EXACT_INT8: self.vnni or "avx2" not in self.needs}

    def added(self, flags: Collection[str]) -> tuple[str, ...]:
        """Return the features that a processor with these flags lacks, but has instructions to carry out."""
        able = [feature for feature, others in CARRIED_OUT_BY.items() if {*others} <= {*flags}]
        return tuple(feature for feature in self.needs if feature not in flags and feature in able)

    def lacking(self, flags: Collection[str]) -> tuple[str, ...]:
        """Return what a processor with these flags lacks for it."""
        return tuple(feature for feature in self.needs if feature not in {*flags, *self.added(flags)})


SETS = (
    InstructionSet("sse42", OLD, like="Celeron J4125, N5105"),
    InstructionSet("avx", (*OLD, "avx"), like="Sandy Bridge"),
    InstructionSet("avx2", (*OLD, *AVX2), VAES, "Haswell to Comet Lake; Zen to Zen 3"),
    InstructionSet("avx2_vnni", (*OLD, *AVX2, "avx_vnni"), VAES, "Alder Lake, N100"),
    InstructionSet("avx512", (*OLD, *AVX512), VAES, "Skylake-X"),
    InstructionSet("avx512_vnni", (*OLD, *AVX512, "avx512_vnni"), (*VAES, *ICE_LAKE), "Ice Lake"),
)
"""The lowest first."""


def possible(flags: Collection[str]) -> tuple[InstructionSet, ...]:
    """Return the sets that a host with these flags can be confined to."""
    return tuple(each for each in SETS if not each.lacking(flags))


def named(name: str, flags: Collection[str]) -> InstructionSet:
    """Return a set that a host with these flags can be confined to.

    Raises:
        RefusedError: when there is none of that name, or the host lacks something that it needs.
    """
    found = next((each for each in SETS if each.name == name), None)
    if found is None:
        known = ", ".join(each.name for each in SETS)
        raise RefusedError(f"there is no set '{name}'; the sets are {known}.")
    if lacks := found.lacking(flags):
        able = ", ".join(each.name for each in possible(flags)) or "none of the sets"
        raise RefusedError(
            f"this host cannot be confined to {name}: its processor lacks {', '.join(map(either, lacks))}; it can be "
            f"confined to {able}."
        )
    return found


def either(feature: str) -> str:
    """Return a feature's name, with those that would do instead."""
    others = CARRIED_OUT_BY.get(feature)
    return f"{feature} (or {' and '.join(others)})" if others else feature


def distinct(flags: Collection[str]) -> tuple[InstructionSet, ...]:
    """Return the possible sets that hide something that a host with these flags has."""
    return tuple(each for each in possible(flags) if each.hidden & {*flags})


def masks(hidden: Collection[str]) -> dict[tuple[int, int], tuple[int, int, int, int]]:
    """Return leaf and subleaf of CPUID -> the bits of the four registers that hide features.

    Example:
        >>> masks(["avx2", "fma"])
        {(1, 4294967295): (0, 0, 4096, 0), (7, 0): (0, 32, 0, 0)}
    """
    found: dict[tuple[int, int], list[int]] = {}
    for (leaf, subleaf, register), bits in BITS.items():
        for bit in (bit for feature, bit in bits.items() if feature in hidden):
            found.setdefault((leaf, subleaf), [0] * 4)[REGISTERS.index(register)] |= 1 << bit
    for leaf, feature in EMPTIED.items():
        if feature in hidden:
            found[leaf, ANY] = [ANY] * 4
    return {place: (words[0], words[1], words[2], words[3]) for place, words in found.items()}


def listing(flags: Collection[str]) -> list[str]:
    """Return a line for each set: whether a host with these flags can be confined to it, and what it needs."""
    lines = []
    for each in SETS:
        lacks = each.lacking(flags)
        added = "".join(f", with {CARRIED_OUT_BY[feature][0]} for {feature}" for feature in each.added(flags))
        state = f"no: this host lacks {', '.join(lacks)}" if lacks else f"yes{added}"
        needs = ", ".join(feature for feature in each.needs if feature not in OLD) or ", ".join(OLD)
        lines.append(f"{each.name:<12} {state}; needs {needs} (as in {each.like})")
    return lines
