"""Frames that are damaged as networks, bugs and attackers damage them: deterministic in the seed."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence

LENGTHS = (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF)


def _flipped(frame: bytearray, draw: random.Random) -> None:
    for _ in range(draw.choice((1, 2, 8))):
        if frame:
            frame[draw.randrange(len(frame))] ^= 1 << draw.randrange(8)


def _cut(frame: bytearray, draw: random.Random) -> None:
    del frame[draw.randrange(len(frame) + 1) :]


def _without(frame: bytearray, draw: random.Random) -> None:
    at = draw.randrange(len(frame) + 1)
    del frame[at : at + draw.choice((1, 4, 64))]


def _doubled(frame: bytearray, draw: random.Random) -> None:
    at = draw.randrange(len(frame) + 1)
    frame[at:at] = frame[at : at + draw.choice((1, 16, 256))] * draw.choice((1, 2, 30))


def _noise(frame: bytearray, draw: random.Random) -> None:
    at = draw.randrange(len(frame) + 1)
    frame[at : at + draw.choice((0, 8))] = draw.randbytes(draw.choice((1, 8, 64)))


def _length(frame: bytearray, draw: random.Random) -> None:
    number, size = draw.choice(LENGTHS), draw.choice((1, 2, 4, 8))
    at = draw.randrange(len(frame) + 1)
    frame[at : at + size] = (number % (1 << 8 * size)).to_bytes(size, draw.choice(("big", "little")))


DAMAGES: tuple[Callable[[bytearray, random.Random], None], ...] = (
    _flipped, _cut, _without, _doubled, _noise, _length,
)  # fmt: skip


def malformed(frames: Sequence[bytes], count: int, seed: int = 0) -> Iterator[bytes]:
    """Yield damaged copies of valid frames, one in twenty pure noise; a few are valid still."""
    draw = random.Random(seed)
    for number in range(count):
        frame = bytearray(draw.choice(frames))
        if number % 20 == 19:
            frame = bytearray(draw.randbytes(draw.choice((0, 1, 7, 100, 3000))))
        for _ in range(draw.choice((1, 1, 1, 2, 5))):
            draw.choice(DAMAGES)(frame, draw)
        yield bytes(frame)
