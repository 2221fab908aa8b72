"""Structured pruning of random modules: what is left computes what the module does without the units that went."""

from __future__ import annotations

import random

import pytest
from _full import small_or_full
from _pruned import check_pruned
from _random_modules import IMAGES, SEQUENCES, RandomModule, chosen

from vlatool.prune._unit_groups import Rank

SEEDS = small_or_full((0, 125, 174, 316), range(1000))
"""Of the modules; the few are small ones, of parts that are joined, grown, padded and skipped."""
PARTS = small_or_full(4, 100)
"""Tests that they are divided among."""


def check(seed: int) -> None:
    """Prune one module and compare."""
    module = RandomModule(seed)
    rank: Rank = "magnitude" if seed % 2 else "random"
    check_pruned(module, [module.example(seed)], f"{seed} {module.kinds}", rank)


@pytest.mark.parametrize("part", range(PARTS))
def test_what_is_left_of_a_random_module_is_the_module_without_its_units(part: int):
    for seed in SEEDS[part::PARTS]:
        check(seed)


def test_each_kind_of_block_is_drawn():
    kinds = {make for seed in range(1000) for blocks in chosen(random.Random(seed)) for make in blocks}
    assert kinds == {*IMAGES, *SEQUENCES}
