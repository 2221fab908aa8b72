"""Some planted wirings, 500 in the full form; ``tests/validation/soak/wiring_trials.py`` prints them by kind."""

from __future__ import annotations

import pytest
from _full import small_or_full
from wiring_elsewhere import FALSE, FOUND, MISSED, Subject
from wiring_elsewhere import _bundle as bundle_of
from wiring_elsewhere import trials as trials_elsewhere
from wiring_recordings import record
from wiring_trials import KINDS, trials


def test_wrong_wirings_are_named_and_right_ones_are_not(tmp_path):
    wrong, right = small_or_full(14, 500), small_or_full(5, 100)
    planted, found, misses = trials(wrong, right, 1, tmp_path)
    assert {kind: planted[kind] for kind in KINDS} == pytest.approx(dict.fromkeys(KINDS, wrong / len(KINDS)), abs=1)
    assert found["right"] == 0, misses
    assert sum(found[kind] for kind in KINDS) >= 0.95 * wrong, misses


def test_wrong_wirings_are_named_in_other_episodes_too(tmp_path):
    episodes = record("vln-gru", reference=2, ordinary=1)
    subject = Subject("vln-gru", bundle_of("vln-gru", tmp_path, tmp_path), episodes)
    table, lines = trials_elsewhere([subject], small_or_full(9, 90), small_or_full(3, 30), 0)
    results = {result: sum(table[key] for key in table if key[2] == result) for result in (FOUND, MISSED, FALSE)}
    assert results[FALSE] == 0, lines
    assert results[FOUND] >= 2 * results[MISSED], lines
