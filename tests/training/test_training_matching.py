"""Which block of a teacher a student's block is compared with."""

from __future__ import annotations

from pathlib import Path

import pytest
from _deep import write_deep

from vlatool.bundle.bundle import Bundle
from vlatool.module.edits import Edit
from vlatool.module.torch_policy import load_modules
from vlatool.prune.depth import Depth
from vlatool.prune.structured import Structured
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.training.matching import kept_blocks, pairs_of, teacher_blocks
from vlatool.training.teacher import Teacher


@pytest.mark.parametrize(("count", "of", "kept", "wanted"), [
    (3, 3, None, [0, 1, 2]),
    (2, 6, None, [2, 5]),
    (4, 6, None, [1, 2, 4, 5]),
    (5, 6, None, [0, 1, 3, 4, 5]),
    (1, 12, None, [11]),
    (3, 2, None, [0, 0, 1]),
    (6, 1, None, [0] * 6),
    (2, 6, (0, 3), [2, 5]),
    (2, 6, (4, 5), [4, 5]),
    (1, 6, (2,), [5]),
    (3, 6, (0, 1, 2), [0, 1, 5]),
    (2, 6, (3, 0), [2, 5]),
    (2, 6, (0, 8), [2, 5]),
    (2, 6, (0, 1, 2), [2, 5]),
    (0, 6, None, []),
])  # fmt: skip
def test_a_block_does_what_followed_it(count: int, of: int, kept: tuple[int, ...] | None, wanted: list[int]):
    assert teacher_blocks(count, of, kept) == wanted


def test_blocks_that_were_removed_twice_are_numbered_as_the_factory_makes_them():
    edits = [Edit("main", "a", "blocks", (0, 2, 4, 5)), Edit("main", "b", "blocks", (1,)),
             Edit("main", "a", "outputs", (0,)), Edit("main", "a", "blocks", (1, 3))]  # fmt: skip
    assert kept_blocks(edits, ("main", "a")) == (2, 5)
    assert kept_blocks(edits, ("other", "a")) is None


@pytest.fixture(scope="module")
def deep(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy with six blocks; read only."""
    place = tmp_path_factory.mktemp("deep")
    folder = write_deep(place / "policy", layers=6)
    return run_transform(TorchModule(policy=folder), None, place / "source", Context()).bundle


def numbers(student: Bundle, teacher: Path | None = None) -> dict[str, list[tuple[int, int]]]:
    modules = load_modules(student)
    found: dict[str, list[tuple[int, int]]] = {}
    for pair in pairs_of(modules, student, Teacher.of(student, teacher, modules)):
        found.setdefault(pair.stack[1], []).append(pair.numbers)
        assert pair.ours == ("main", f"blocks.{pair.numbers[0]}")
        assert pair.theirs == ("main", f"blocks.{pair.numbers[1]}")
    return found


def test_the_edits_say_which_blocks_are_there(deep: Bundle, tmp_path: Path):
    once = run_transform(Depth(keep=(0, 1, 2, 5)), deep, tmp_path / "once", Context()).bundle
    twice = run_transform(Depth(keep=(0, 2)), once, tmp_path / "twice", Context()).bundle
    assert numbers(once) == {"blocks": [(0, 0), (1, 1), (2, 4), (3, 5)]}
    assert numbers(twice) == {"blocks": [(0, 1), (1, 5)]}, "blocks 0 and 2 of the six are left"
    assert numbers(twice, deep.path) == numbers(twice), "a teacher from the same factory, whole"
    assert numbers(twice, once.path) == {"blocks": [(0, 1), (1, 3)]}, "one that lost blocks: by the share of the depth"


def test_traced_modules_have_stacks_too(tmp_path: Path):
    folder = write_deep(tmp_path / "policy", layers=2)
    source = run_transform(TorchModule(policy=folder), None, tmp_path / "source", Context()).bundle
    narrow = run_transform(Structured(ratio=0.3, samples=2, multiple=1), source, tmp_path / "narrow", Context()).bundle
    shallow = run_transform(Depth(keep=(0,)), source, tmp_path / "shallow", Context()).bundle
    assert numbers(narrow) == {"blocks": [(0, 0), (1, 1)]}
    assert numbers(shallow, narrow.path) == {"blocks": [(0, 1)]}
