"""Records as a stack gives them, and damage to what is written of them."""

from typing import Any

import numpy as np

from vlatool.runtime.interface import POLICY, Origin
from vlatool.runtime.telemetry import TickRecord


def record(step: int = 0, **changes: Any) -> TickRecord:
    """Return the record of a control step of 2 ms."""
    origin = Origin(POLICY, 3.5, ("velocity",))
    parts = (0.1, 1.0, 0.2, 0.05, 0.15, 0.25)
    values = TickRecord(step, step * 0.05, 0.25, 2.0, False, 0, 0, origin, "", np.float32([step, 0.5]), 1.5, parts)
    return values._replace(**changes)


def altered(content: bytes, random: np.random.Generator) -> bytes:
    """Return a content with a bit flipped, a part cut out, repeated, zeroed, exchanged, or rubbish inserted."""
    begin, size = int(random.integers(len(content))), int(random.integers(1, 400))
    part = content[begin : begin + size]
    if (kind := random.integers(6)) == 0:
        flipped = bytearray(content)
        flipped[begin] ^= 1 << int(random.integers(8))
        return bytes(flipped)
    middle = (b"", part * 2, bytes(len(part)), part[::-1], random.bytes(len(part)))[kind - 1]
    return content[:begin] + middle + content[begin + size :]
