from dataclasses import replace

import pytest

from vlatool.benchmark.overhead import Overhead
from vlatool.bundle import Bundle
from vlatool.errors import UsageError
from vlatool.stage import Context


def test_the_overhead_is_the_median_over_pairs_of_rounds(float_bundle):
    told = []
    report = Overhead(iterations=400).run(float_bundle, Context(lambda what, share: told.append((what, share))))
    (row,) = report.rows
    found = row.get("overhead_p50")
    assert (found.unit, found.samples, len(row.raw["overhead_us"])) == ("us", 10, 10)
    assert found.low <= found.value <= found.high
    assert row.value("bare_run_p50") > 0
    assert report.kind == "benchmark"
    assert "infer() adds" in report.summary[0]
    assert told == [*(("measuring rounds", number / 11) for number in range(11)), ("measuring calls in turn", None)]
    in_turn = row.get("overhead_in_turn_p50")
    assert (in_turn.unit, in_turn.samples) == ("us", 400)
    assert in_turn.low <= in_turn.value <= in_turn.high


def test_a_graph_that_runs_twice_has_no_single_bare_call(float_bundle):
    step = replace(float_bundle.manifest.program[0], repeat=2)
    for program in ((step,), (step, step)):
        twice = Bundle(float_bundle.path, replace(float_bundle.manifest, program=program))
        with pytest.raises(UsageError, match="one graph that runs once"):
            Overhead(iterations=100).run(twice, Context())
    Overhead().check(None, None)
