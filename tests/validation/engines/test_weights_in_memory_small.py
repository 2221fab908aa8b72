"""The script runs on a tiny bundle, whose process needs little more than without it."""

from __future__ import annotations

import weights_in_memory

from vlatool.bundle.bundle import Bundle


def test_a_tiny_bundle_takes_little(float_bundle: Bundle) -> None:
    found = weights_in_memory.measured(float_bundle.path, "ort_cpu")
    assert list(found) == list(weights_in_memory.COLUMNS)
    assert 0 < found["graphs"] < 1
    assert found["before"] < found["rss"] < found["before"] + 60
    assert found["anonymous"] < found["rss"] <= found["peak"]
