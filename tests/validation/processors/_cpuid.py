"""CPUID instructions in shared libraries: found among the bytes that only look like one, and replaced.

CPUID is two bytes, 0F A2, and so is ``MARK``, an instruction that every processor refuses. The same two bytes stand in
constants and addresses as well: a function is disassembled from its first byte, and where they are not an instruction
they are left alone.
"""

from __future__ import annotations

import bisect
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

CPUID, MARK = b"\x0f\xa2", b"\x0f\x04"
ELF = b"\x7fELF"
TABLE = b"\x01\x1b\x03\x3b"
"""Head of ``.eh_frame_hdr`` as linkers write it: version 1; a sorted table of pairs of 32 bits from its own start."""
LONGEST = 1 << 20
"""Bytes of a function at most: what begins further away is another."""
BEFORE = 256
"""Bytes to begin before, where no function is known: disassembly falls into step within a few instructions."""


@dataclass(frozen=True)
class Found:
    """The places of a library that hold the bytes of CPUID.

    Args:
        instructions: Offsets in the file at which it is one.
        others: How many are none.
    """

    instructions: tuple[int, ...]
    others: int


@dataclass(frozen=True)
class Section:
    """Machine code of a library.

    Args:
        address: Of its first byte in memory.
        offset: Of its first byte in the file.
        size: In bytes.
    """

    address: int
    offset: int
    size: int


class Library:
    """A shared library for x86-64."""

    def __init__(self, elf: Any, content: bytes) -> None:
        """Take an open file of pyelftools, and its bytes."""
        from capstone import CS_ARCH_X86, CS_MODE_64, Cs

        self._elf, self._content = elf, content
        self._engine = Cs(CS_ARCH_X86, CS_MODE_64)
        self._engine.skipdata = True

    def search(self) -> Found:
        """Return where CPUID is."""
        instructions, others = [], 0
        for section in self._sections():
            for offset in offsets(self._content, section):
                if self._is_instruction(section, offset):
                    instructions.append(offset)
                else:
                    others += 1
        return Found(tuple(instructions), others)

    def _sections(self) -> Iterator[Section]:
        for each in self._elf.iter_sections():
            if each["sh_type"] == "SHT_PROGBITS" and each["sh_flags"] & 4:  # SHF_EXECINSTR
                yield Section(each["sh_addr"], each["sh_offset"], each["sh_size"])

    def _is_instruction(self, section: Section, offset: int) -> bool:
        """Say whether the two bytes are an instruction when the function around them is read from its first byte."""
        begin = self._begin(section, offset)
        address = section.address + begin - section.offset
        target = address + offset - begin
        for at, _, name, _ in self._engine.disasm_lite(self._content[begin : offset + 16], address):
            if at >= target:
                return at == target and name == "cpuid"
        return False

    def _begin(self, section: Section, offset: int) -> int:
        """Return the offset of the function's first byte, or of one well before the bytes where none is known."""
        target = section.address + offset - section.offset
        index = bisect.bisect_right(self._functions, target) - 1
        start = self._functions[index] if index >= 0 else -1
        if start < section.address or target - start > LONGEST:
            return max(section.offset, offset - BEFORE)
        return section.offset + start - section.address

    @cached_property
    def _functions(self) -> list[int]:
        """Addresses of functions, from the unwind table and the symbols."""
        known = set(self._unwound())
        for table in (".dynsym", ".symtab"):
            section = self._elf.get_section_by_name(table)
            symbols = section.iter_symbols() if section is not None and section["sh_type"] != "SHT_NOBITS" else ()
            known |= {each["st_value"] for each in symbols if each["st_info"]["type"] == "STT_FUNC"} - {0}
        return sorted(known)

    def _unwound(self) -> list[int]:
        section = self._elf.get_section_by_name(".eh_frame_hdr")
        if section is None or section.data()[:4] != TABLE:
            return []
        data, base = section.data(), section["sh_addr"]
        (count,) = struct.unpack_from("<I", data, 8)
        return [base + entry for entry in struct.unpack_from(f"<{2 * count}i", data, 12)[::2]]


def offsets(content: bytes, section: Section) -> Iterator[int]:
    """Return where the bytes of CPUID are in a section, as offsets in the file."""
    end = section.offset + section.size
    at = content.find(CPUID, section.offset, end)
    while at >= 0:
        yield at
        at = content.find(CPUID, at + 1, end)


def search(path: Path) -> Found:
    """Return where CPUID is in a file; nowhere in what is no library for x86-64."""
    from elftools.elf.elffile import ELFFile

    content = path.read_bytes()
    if content[:4] != ELF or CPUID not in content:
        return Found((), 0)
    with path.open("rb") as stream:
        elf = ELFFile(stream)
        return Library(elf, content).search() if elf["e_machine"] == "EM_X86_64" else Found((), 0)


def replace(path: Path, instructions: tuple[int, ...]) -> None:
    """Write a file anew with CPUID replaced: a hard link of a package cache keeps what it has, as a process does."""
    content = bytearray(path.read_bytes())
    for offset in instructions:
        content[offset : offset + 2] = MARK
    draft = path.with_name(f".{path.name}.confined")
    try:
        draft.write_bytes(content)
        draft.chmod(path.stat().st_mode)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
