"""Candidates play their episodes in the order in which they would be chosen, until one keeps to the limits."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from vlatool.optimize import evidence
from vlatool.optimize.evidence import with_episodes
from vlatool.optimize.judge import judge
from vlatool.optimize.ranking import in_order
from vlatool.optimize.recipe import Limits
from vlatool.report import Measurement, Report, Row
from vlatool.stage.base import Context


def row(name: str, ms: float, error: float) -> Row:
    return Row(name, measurements=(Measurement("latency_p50", ms, "ms"), Measurement("error_baseline", error, "1")))


ROWS = [row("slow", 2.0, 0.01), row("fast", 1.0, 0.04), row("level", 1.008, 0.02), row("next", 1.2, 0.03)]


def test_of_equally_fast_candidates_the_nearest_to_float32_is_first() -> None:
    assert [each.name for each in in_order(ROWS)] == ["level", "fast", "next", "slow"]
    behind = [row("fast", 1.0, 0.04), row("accurate", 1.02, 0.001)]
    assert [each.name for each in in_order(behind)] == ["fast", "accurate"], "two per cent are not given away"
    assert in_order([]) == []
    assert [each.name for each in in_order([Row("unknown"), ROWS[0]])] == ["slow", "unknown"]


@pytest.fixture
def played(monkeypatch) -> list[str]:
    """The bundles that played, in order; there are no controls."""
    names: list[str] = []

    def measure(_loop, bundle, *_more, **_options) -> Report:
        names.append(bundle)
        success = Measurement("success", 0.9, "1", samples=10)
        return Report("evaluate", "t", rows=(Row(bundle, measurements=(success,)),))

    monkeypatch.setattr(evidence, "cached_measure", measure)
    monkeypatch.setattr(evidence, "with_chance", lambda own, _controls: own)
    monkeypatch.setattr(evidence, "compare_success", lambda _base, own: own)
    return names


LOOP = SimpleNamespace(controls=list)


def accuracy(enough):
    rows = {each.name: each for each in [row("float32", 4.0, 0.0), *ROWS]}
    return with_episodes(rows, {name: name for name in rows}, LOOP, None, Context(), enough)


def test_slower_ones_do_not_play_once_one_keeps_to_the_limits(played: list[str]) -> None:
    found = accuracy(lambda candidate, _base: candidate.name == "fast")
    assert played == ["float32", "level", "fast"]
    assert found["next"].get("success") is None
    assert "fast keeps to the limits" in found["next"].reason
    assert "--every-candidate" in found["slow"].reason
    assert found["level"].reason == ""


def test_all_play_when_none_keeps_to_the_limits_or_all_are_asked_for(played: list[str]) -> None:
    accuracy(lambda *_: False)
    assert played == ["float32", "level", "fast", "next", "slow"]
    played.clear()
    accuracy(None)
    assert played == ["float32", "slow", "fast", "level", "next"]


def test_one_that_did_not_play_is_neither_within_nor_chosen(played: list[str]) -> None:
    found = accuracy(lambda candidate, _base: candidate.name == "fast")
    judged = judge(found["next"], found["float32"], Limits(), None)
    assert not judged.within
    assert judged.row.reason == found["next"].reason
    assert judged.row.role == "subject"
    unknown = replace(found["next"], reason="")
    assert judge(unknown, found["float32"], Limits(), None).row.role == "outside"
