from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from vlatool.boards.simulate import bounds, changes, parts_of, timeline, widest
from vlatool.graph.workload import GraphWorkload, Workload
from vlatool.hardware.profile import load_profile
from vlatool.latency_model.board import Candidate, Outcome, outcomes
from vlatool.latency_model.model import LatencyModel

Load = Callable[..., Workload]
PI = Candidate(load_profile("raspberry-pi-5"), "default", "ort_cpu", "float32")


@pytest.fixture
def policy(load: Load) -> Workload:
    """A prefix on images, and ten steps whose weights are most of it."""
    prefix = load(gmacs=4.0, weights_m=20.0).graphs["main"]
    step = load(gmacs=0.05, weights_m=50.0, activations=10_000).graphs["main"]
    return Workload({"prefix": prefix, "step": step}, {"prefix": 1, "step": 10})


@pytest.fixture
def outcome(certain: LatencyModel, policy: Workload) -> Outcome:
    return outcomes([PI], policy, certain)[0]


def test_each_phase_says_what_holds_it_back(outcome: Outcome, certain: LatencyModel) -> None:
    prefix, step = bounds(outcome, certain.shares)
    assert (prefix.by, step.by) == ("compute", "memory")
    for bound in (prefix, step):
        assert set(bound.shares) == {"compute", "memory", "overhead"}
        assert sum(bound.shares.values()) == pytest.approx(1)


def test_parts_share_the_time_by_their_work(certain: LatencyModel, load: Load) -> None:
    """Three times the work in every respect is three times the time; what no part names is told, too."""
    small = (10**8, 10**6, 10**5, 4)
    graph = replace(
        load().graphs["main"], parts={"vision": tuple(3 * each for each in small), "head": small, "": small}
    )
    (phase,) = outcomes([PI], Workload({"main": graph}, {"main": 1}), certain)[0].phases
    found = parts_of(phase, graph, certain.shares)
    assert found == {"vision": pytest.approx(0.6), "head": pytest.approx(0.2), "other": pytest.approx(0.2)}
    bound = replace(graph, parts={"vision": (10**9, 1, 1, 0), "head": (0, 10**9, 0, 0)})
    assert parts_of(phase, bound, certain.shares)["head"] != pytest.approx(0.5, abs=0.05), "operations are not bytes"
    assert parts_of(phase, replace(graph, parts={}), certain.shares) == {}


def test_the_time_line_runs_from_begin_to_end(outcome: Outcome, certain: LatencyModel) -> None:
    first, second = timeline(bounds(outcome, certain.shares), width=40)
    assert first.startswith("prefix")
    assert f" {outcome.phases[0].ms:.3g} ms" in first
    assert "compute" in first
    assert f"10x{outcome.phases[1].once.ms:.3g}" in second
    assert "memory" in second
    assert first.index("█") == 17
    assert abs(second.index("█") - first.rindex("█") - 1) <= 1, "one begins where the other ends"
    assert first.count("█") + second.count("█") in (40, 41)


def test_changes_are_predicted_for_the_same_board(certain: LatencyModel, policy: Workload, outcome: Outcome) -> None:
    found = {change.name: change.outcome for change in changes(PI, policy, certain)}
    assert [name for name in found if "in the place of float32" in name] == [
        f"{precision} in the place of float32" for precision in ("int8", "w8", "w4")
    ]
    assert found["step: 5 steps in the place of 10"].latency.ms == pytest.approx(
        outcome.latency.ms - 5 * outcome.phases[1].once.ms
    )
    assert found["int8 in the place of float32"].memory_mb[0] < outcome.memory_mb[0]
    smaller = found["images of 0.7 of the side, where prefix works on image tokens alone"]
    assert smaller.phases[0].question.work.macs == 2e9
    assert smaller.phases[1].question.work == outcome.phases[1].question.work
    pruned = found["30 % of each layer pruned, whole channels"]
    assert pruned.phases[1].question.work.weights == int(50e6 * 0.7)
    assert all(each.candidate.profile is PI.profile for each in found.values())


def test_a_quantized_bundle_is_not_offered_other_precisions(certain: LatencyModel, load: Load) -> None:
    names = [change.name for change in changes(replace(PI, precision=""), load(precision="int8"), certain)]
    assert not any("in the place of" in name for name in names)


def test_the_widest_graph_is_the_one_on_images(policy: Workload) -> None:
    assert widest(policy) == "prefix"
    assert widest(Workload({"a": GraphWorkload()}, {"a": 1})) == "a"


def test_a_time_line_of_nothing_is_empty() -> None:
    assert list(timeline([])) == []
