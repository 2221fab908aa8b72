"""Some planted wirings, 500 in the full form; ``tests/validation/soak/wiring_trials.py`` prints them by kind."""

from __future__ import annotations

import pytest
from _full import small_or_full
from wiring_trials import KINDS, trials


def test_wrong_wirings_are_named_and_right_ones_are_not(tmp_path):
    wrong, right = small_or_full(14, 500), small_or_full(5, 100)
    planted, found, misses = trials(wrong, right, 1, tmp_path)
    assert {kind: planted[kind] for kind in KINDS} == pytest.approx(dict.fromkeys(KINDS, wrong / len(KINDS)), abs=1)
    assert found["right"] == 0, misses
    assert sum(found[kind] for kind in KINDS) >= 0.95 * wrong, misses
