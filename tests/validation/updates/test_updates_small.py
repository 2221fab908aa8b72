"""Small forms of the scripts on updates: kills, power cuts and damage."""

import random

from _full import small_or_full
from _slots import bundle_of
from update_corruption import SHARES, Trial, run
from update_crashes import cases, cut, recorded
from update_kills import run as run_kills


def test_no_kill_breaks_the_active_slot_and_kills_in_place_do(tmp_path):
    broken, changes, in_place_broken = run_kills(small_or_full(5, 300), small_or_full(4, 50), 0, tmp_path)
    assert broken == 0
    assert changes > 0
    assert in_place_broken > 0


def test_no_power_cut_breaks_the_active_slot_and_without_flushes_it_does(tmp_path):
    each = small_or_full(15, 1)
    bundles = [bundle_of(tmp_path / f"bundle {value}", value) for value in (1, 2, 3)]
    before, change = cases(bundles)["deployment into an empty slot"]
    recorder = recorded(tmp_path / "store", bundles, before, change)
    assert len(recorder.steps) > 20
    draws = small_or_full(0, 20)
    count, wrong = cut(recorder, bundles, tmp_path, draws, 0, first=False, each=each)
    assert wrong == []
    assert count > 100
    assert cut(recorder, bundles, tmp_path, 0, 0, first=False, flushed=False, each=each)[1]


def test_nothing_damaged_is_accepted(tmp_path):
    trial = Trial(tmp_path, random.Random(0))
    for kind in SHARES:
        counts = run(trial, kind, small_or_full(60, 20_000), 1e9)
        assert set(counts) <= {"refused", "unchanged", "forged"}, counts
        assert counts["refused"] > 30
