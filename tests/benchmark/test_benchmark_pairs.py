"""What a process measures is counted and ordered; no test asserts a time."""

from __future__ import annotations

import math

import pytest

from vlatool.benchmark import _pairs
from vlatool.benchmark._pairs import FEWEST, Job, Pairs, measure_pairs, run_job
from vlatool.bundle import Bundle
from vlatool.errors import BundleError, GraphError


@pytest.fixture
def job(float_bundle: Bundle, int8_bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> Job:
    monkeypatch.setattr(_pairs, "WARMUP_MS", 0.0)
    monkeypatch.setattr(_pairs.gc, "freeze", lambda: None)
    monkeypatch.setattr(_pairs.gc, "disable", lambda: None)
    return Job(str(float_bundle.path), str(int8_bundle.path), warmup=1, pairs=40)


def test_every_call_of_both_is_kept(job: Job) -> None:
    found = run_job(job)
    assert len(found.baseline_ms) == len(found.candidate_ms) == 40
    assert min(found.baseline_ms + found.candidate_ms) > 0


def test_a_slow_policy_is_called_less_often_but_often_enough(job: Job) -> None:
    found = run_job(Job(**{**vars(job), "seconds": 1e-9}))
    assert len(found.baseline_ms) == len(found.candidate_ms) == FEWEST


def test_a_fresh_process_measures_the_same(job: Job) -> None:
    found = measure_pairs(job)
    assert len(found.baseline_ms) == len(found.candidate_ms) == 40
    assert math.isfinite(found.log_ratio)


def test_the_log_ratio_is_of_medians_and_positive_is_slower() -> None:
    assert Pairs((1.0, 2.0, 90.0), (3.0, 4.0, 5.0)).log_ratio == pytest.approx(math.log(2))
    assert Pairs((2.0,), (1.0,)).log_ratio < 0


def test_the_order_of_calls_is_drawn(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither bundle is always the first of a pair, nor loaded first in every process."""
    told: list[str] = []

    class Spy:
        def __init__(self, name: str) -> None:
            self.name = name

        def infer(self, _: object) -> None:
            told.append(self.name)

    from vlatool.runtime import policy

    monkeypatch.setattr(policy.Policy, "open", lambda bundle, **_: Spy(str(bundle.path)))
    for seed in range(6):
        run_job(Job(**{**vars(job), "seed": seed}))
    names = sorted(set(told))
    assert len(names) == 2
    firsts = told[2::2]
    assert 0.3 < firsts.count(names[0]) / len(firsts) < 0.7
    runs = [told[start] for start in range(0, len(told), 82)]
    assert set(runs) == set(names), "each is loaded first in some process"


def test_a_bundle_that_cannot_run_is_named(job: Job, tmp_path) -> None:
    with pytest.raises(BundleError, match=r"There is no bundle at .*none"):
        measure_pairs(Job(**{**vars(job), "candidate": str(tmp_path / "none")}))


def test_a_process_that_hangs_is_ended(job: Job) -> None:
    with pytest.raises(GraphError, match="no result after"):
        measure_pairs(job, timeout=0.01)
