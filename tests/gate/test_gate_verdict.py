"""Verdicts are values: what an interval says of a limit, what the worst of several is, and words made of them."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from vlatool.errors import DataError, PluginError
from vlatool.gate.claim import Claim
from vlatool.gate.evidence import Evidence
from vlatool.gate.plan import Need, Plan
from vlatool.gate.verdict import Judgement, Outcome, Reason, Verdict, judge_interval, samples_wanted, worst
from vlatool.measurement.agreement import Agreement
from vlatool.report import Measurement
from vlatool.stage.base import Context


def number(value: float, low: float | None, high: float | None, unit: str = "1") -> Measurement:
    return Measurement("lost", value, unit, samples=100, low=low, high=high)


@pytest.mark.parametrize(
    ("low", "high", "outcome"),
    [
        (0.2, 0.3, Outcome.FAIL), (0.0, 0.1, Outcome.PASS), (0.1, 0.2, Outcome.INCONCLUSIVE),
        (0.05, 0.15, Outcome.INCONCLUSIVE), (None, 0.05, Outcome.INCONCLUSIVE), (0.2, None, Outcome.INCONCLUSIVE),
        (math.nan, math.nan, Outcome.INCONCLUSIVE), (-math.inf, math.inf, Outcome.INCONCLUSIVE),
    ],
)  # fmt: skip
def test_an_interval_decides(low: float | None, high: float | None, outcome: Outcome):
    assert judge_interval(number(0.1, low, high), 0.1).outcome is outcome


def test_the_worst_decides_and_nothing_decides_nothing():
    judged = [Judgement(outcome, outcome.value) for outcome in (Outcome.PASS, Outcome.FAIL, Outcome.INCONCLUSIVE)]
    assert Verdict.of(judged).outcome is Outcome.FAIL
    assert [each.title for each in Verdict.of(judged).decisive] == ["fail"]
    assert Verdict.of([judged[0], judged[2]]).outcome is Outcome.INCONCLUSIVE
    assert Verdict.of(judged[:1]).outcome is Outcome.PASS
    assert (worst([]), Verdict.of([]).outcome) == (Outcome.INCONCLUSIVE, Outcome.INCONCLUSIVE)


def test_an_open_interval_says_how_many_samples_would_decide():
    assert samples_wanted(judge_interval(number(0.0, -0.02, 0.02), 0.01)) == 400
    assert samples_wanted(judge_interval(number(0.0, -0.02, 0.02), 0.05)) == 0, "decided"
    assert samples_wanted(judge_interval(number(0.01, 0.0, 0.02), 0.01)) == 0, "on the limit"
    assert samples_wanted(judge_interval(number(0.0, None, None), 0.01)) == 0, "no interval"


class _Plain(Claim):
    """A claim with the words of the base class."""

    needs: ClassVar[frozenset[Need]] = frozenset({Need.RECORDINGS})


@pytest.mark.parametrize(
    ("judgement", "words"),
    [
        (judge_interval(number(0.2, 0.1, 0.3, "ms"), 0.05, "slip"), "slip 0.2 ms (0.1 to 0.3; allowed: 0.05 ms)"),
        (judge_interval(number(0.2, None, None), 0.05), "lost 0.2 (allowed: 0.05)"),
        (Judgement(Outcome.INCONCLUSIVE, reason=Reason.NO_EVIDENCE), "there is nothing to judge"),
        (Judgement(Outcome.INCONCLUSIVE, "slip", reason=Reason.FEW_STARTS), "slip: episodes begin in too few ways"),
    ],
)
def test_a_claim_without_words_of_its_own_has_some(judgement: Judgement, words: str):
    assert _Plain().sentence(Verdict.of([judgement])) == words
    assert _Plain().sentence(Verdict.of([])) == "there is nothing to judge"


def test_a_claim_is_refused_where_its_evidence_is_missing(tmp_path: Path):
    bare: Any = SimpleNamespace(path=tmp_path, manifest=SimpleNamespace(files={}))
    with pytest.raises(DataError, match="needs recorded observations"):
        _Plain().check(bare, Plan())
    _Plain().check(bare, Plan(data=tmp_path))
    evidence = Evidence(bare, bare, _Plain().extend_plan(Plan()), Context(), None, None, Agreement())  # type: ignore[arg-type]
    for need in ("episodes", "agreement"):
        with pytest.raises(PluginError, match=f"looks at {need}"):
            getattr(evidence, need)
    with pytest.raises(PluginError, match="has no method examine"):
        _Plain().examine(evidence)
