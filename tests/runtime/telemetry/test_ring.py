"""The ring: a record is returned once, or counted as dropped, whoever is slow."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest

from vlatool.runtime.telemetry.ring import Reader, Ring


@pytest.mark.parametrize("seed", range(3))
def test_each_record_is_taken_once_in_order_or_counted_as_dropped(seed: int):
    random, ring = np.random.default_rng(seed), Ring(int(np.random.default_rng(seed).integers(1, 9)))
    readers, put = [Reader(ring), Reader(ring)], 0
    taken: list[list[int]] = [[], []]
    for _ in range(400):
        for _ in range(random.integers(0, 6)):
            ring.put(put)
            put += 1
        chosen = int(random.integers(2))
        for _ in range(random.integers(0, 6)):
            if (record := readers[chosen].take()) is not None:
                taken[chosen].append(record)
    for reader, seen in zip(readers, taken, strict=True):
        while (record := reader.take()) is not None:
            seen.append(record)
        assert seen == sorted(set(seen))
        assert (reader.taken, reader.taken + reader.dropped) == (len(seen), put)
        assert seen[-ring.size :] == list(range(put))[-ring.size :], "the newest are still there"


def test_several_writers_lose_nothing():
    ring, switch = Ring(5000), sys.getswitchinterval()
    reader = Reader(ring)
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=lambda: [ring.put(number) for number in range(1000)]) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(switch)
    records = [reader.take() for _ in range(4000)]
    assert sorted(records) == sorted(list(range(1000)) * 4)
    assert (reader.take(), reader.dropped) == (None, 0)
