"""A part of ``broken_policies.py``: mostly cases that share an export, and so are fast."""

from __future__ import annotations

from pathlib import Path

import pytest
from _full import small_or_full
from broken_cases import CASES, Case
from broken_policies import judge_case, rightly

NAMES = (
    "wrapper forgot two layers", "cameras swapped", "collapsed policy, recordings alone", "always one label",
    "expert shuffled", "expert constant", "expert in degrees", "labels permuted", "images recorded BGR",
    "success under another key", "success told when it happens alone", "success is never true",
    "success is always true",    "episodes end at once, as successes", "success by the dice", "int8 scales corrupted",
    "honest", "honest, recordings alone", "honest, world alone, is_success",
    "honest, success told before the end alone",    "honest, final_info", "honest, discrete",
)  # fmt: skip
FEW = (
    "wrapper forgot two layers", "collapsed policy, recordings alone", "expert in degrees", "success by the dice",
    "int8 scales corrupted", "honest, recordings alone", "honest, discrete",
)  # fmt: skip
"""A break of each part: export, training, recording, success, bundle; and honest policies of both kinds of action."""
FAST = [case for case in CASES if case.name in small_or_full(FEW, NAMES)]


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where exports are kept that cases share."""
    return tmp_path_factory.mktemp("kept")


def test_there_are_thirty_broken_ones_and_five_honest_ones_at_least() -> None:
    assert sum(not case.honest for case in CASES) >= 30
    assert sum(case.honest for case in CASES) >= 5
    assert len(FAST) == len(small_or_full(FEW, NAMES))
    assert {*FEW} <= {*NAMES} <= {case.name for case in CASES}
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("case", FAST, ids=lambda case: case.name)
def test_what_is_broken_does_not_pass_and_what_is_honest_does(case: Case, kept: Path, tmp_path: Path) -> None:
    found = judge_case(case, tmp_path, kept)
    assert rightly(case, found), found
