"""The small form of ``frames.py``: some random frames against the libraries that are installed."""

from __future__ import annotations

import pytest
from _full import small_or_full
from frames import EQUAL, compare, libraries


def test_random_frames_are_what_the_libraries_make_of_them() -> None:
    found = libraries()
    if not found:
        pytest.skip("needs PIL, OpenCV or torch")
    tallies = compare(small_or_full(40, 10_000), 3, found)
    assert {like for like, _, _ in tallies} == set(found)
    for (like, kind, _), tally in tallies.items():
        assert tally.worst <= 1.001, (like, kind, tally.where)
        assert not tally.different or (like, kind) not in EQUAL, (like, kind, tally.where)
