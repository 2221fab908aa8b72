from __future__ import annotations

import pytest
from _examined import found as examined

from vlatool.gate.claims.deadline import MAX_PROCESSES, MIN_PROCESSES, Deadline


@pytest.mark.parametrize(("ms", "verdict"), [(20.0, "pass"), (5.0, "fail"), (0.1, "fail")])
def test_the_percentile_is_held_against_the_deadline(timed, ms: float, verdict: str) -> None:
    found = examined(Deadline(ms=ms), timed=timed())
    assert (found.claim, found.verdict) == ("deadline", verdict)
    assert f"allowed: {ms:g} ms" in found.sentence
    (measured,) = found.measurements
    assert measured.name == "latency_p99"
    assert measured.high >= measured.value


def test_near_the_deadline_nothing_is_decided(timed) -> None:
    processes = timed()
    value = examined(Deadline(ms=100), timed=processes).measurements[0]
    between = (value.value + value.high) / 2
    assert examined(Deadline(ms=between), timed=processes).verdict == "inconclusive"


def test_processes_are_measured_until_there_are_calls_enough(timed) -> None:
    processes = timed(calls=60)
    examined(Deadline(ms=100, percent=50), timed=processes)
    assert len(processes.pairs) == MIN_PROCESSES, "one process alone says nothing of others"
    examined(Deadline(ms=100, percent=99), timed=processes)
    assert len(processes.pairs) > MIN_PROCESSES


def test_a_percentile_without_calls_enough_is_not_stated(timed) -> None:
    found = examined(Deadline(ms=100, percent=99.9), timed=timed(calls=30))
    assert found.verdict == "inconclusive"
    assert found.measurements == ()
    assert found.sentence.startswith(f"p99.9 needs 6636 independent calls; {30 * MAX_PROCESSES} are worth ")


def test_a_deadline_that_every_call_misses_fails_however_few_they_are(timed) -> None:
    assert examined(Deadline(ms=1, percent=99.9), timed=timed(calls=30)).verdict == "fail"
