"""A few hundred attacks of each kind; the scripts beside this file make as many as are wanted."""

import random

import flips
import mutants
import swaps
import victim
import walls
from _full import small_or_full
from mutations import mutated, read


def test_mutants_are_refused_or_answer_as_before():
    count = small_or_full(60, 300)
    found = mutants.soak(count, seed=7, workers=1)
    assert {name: found.counts[name] for name in mutants.ZERO} == dict.fromkeys(mutants.ZERO, 0), found.examples
    told = sum(count for name, count in found.counts.items() if name.startswith(mutants.REFUSED))
    assert found.counts.total() == count
    assert told > 2 / 3 * count


def test_the_attack_sees_an_answer_that_changed(tmp_path):
    original = read(victim.make(tmp_path / "original").path)
    (tmp_path / "attacked").mkdir()
    attack = mutants.Attack(original, tmp_path / "attacked", 0)
    chunk, labels, rate = attack.wanted[0]
    other = [(-chunk, labels, rate), *attack.wanted[1:]]
    assert attack._judged(other, original, 1, False, False)[0] == mutants.UNREPAIRED
    assert attack._judged(other, original, 1, True, False)[0] == mutants.CAUGHT_NOT
    assert attack._judged(attack.wanted, original, 1, False, False)[0] == mutants.SAME


def test_a_worker_that_dies_is_counted_and_replaced(monkeypatch):
    def dies(self, number, found):
        if number == 3:
            mutants.os.abort()
        found.add(mutants.SAME)

    monkeypatch.setattr(mutants.Attack, "attempt", dies)
    found = mutants.soak(8, seed=0, workers=1)
    assert found.counts[mutants.CRASH] == 1
    assert found.counts[mutants.SAME] == 7


def test_mutations_are_the_same_for_the_same_seed(tmp_path):
    original = read(victim.make(tmp_path / "original").path)
    assert mutated(original, random.Random(3)) == mutated(original, random.Random(3))
    assert sum(mutated(original, random.Random(seed)) == original for seed in range(100)) < 20


def test_no_flipped_bit_of_a_manifest_is_loaded(tmp_path):
    counts = flips.flip_all(tmp_path / "bundle", 61)
    assert set(counts) == {"refused: BundleError"}
    assert counts.total() > 300


def test_a_flipped_bit_under_a_repaired_digest_is_no_raw_exception(tmp_path):
    counts = flips.flip_all(tmp_path / "bundle", 301, repair=True)
    assert not counts[flips.FAR]
    assert not [name for name in counts if name.startswith(flips.RAW)]


def test_no_load_takes_what_was_swapped(tmp_path):
    counts = swaps.attack(tmp_path, 40)
    assert not counts[swaps.WRONG]
    assert counts["(swaps)"] > 4


def test_links_bombs_and_files_without_end_are_refused(tmp_path):
    counts = walls.run(tmp_path)
    assert counts[walls.LOADED] == 0
    assert counts["refused: BundleError"] == len(walls.FREE) + 1
    assert counts["refused: SpecError"] == 4
