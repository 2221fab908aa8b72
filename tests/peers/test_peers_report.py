"""Which rows dominate which: two processes of one graph never do, whatever the noise of their median."""

import pytest
from _interleave import CLOCKS, Contestant
from _report import Table

NOISE = [1.0, 1.05, 0.96, 1.03, 0.97, 1.01, 0.99, 1.04, 0.95, 1.02]


def contestant(name: str, milliseconds: list[float], error: float, group: int = 0) -> Contestant:
    rounds = dict.fromkeys(CLOCKS, milliseconds)
    reference = {clock: [40.0] * len(milliseconds) for clock in CLOCKS}
    return Contestant(name, name, error=error, engine="ort_cpu", group=group, rounds=rounds, reference=reference)


@pytest.mark.parametrize("group", [0, 1])
@pytest.mark.parametrize(("times", "dominated"), [(0.8, True), (0.97, False), (1.1, False)])
def test_a_peer_dominates_when_it_is_faster_beyond_chance(times: float, dominated: bool, group: int):
    own = contestant("ours:int8", [10 * factor for factor in NOISE], 0.03)
    peer = contestant("peer", [10 * times * factor for factor in reversed(NOISE)], 0.03, group)
    assert Table("vit-s", [own, peer], "cpu").dominates(peer, own) is dominated


def test_a_peer_that_is_more_wrong_dominates_nothing():
    own, peer = contestant("ours:int8", [10.0] * 10, 0.03), contestant("peer", [5.0] * 10, 0.031)
    table = Table("vit-s", [own, peer], "cpu")
    assert not table.dominates(peer, own)
    assert table.checks()[0].passed


def test_the_fastest_within_the_budget_is_held_against_the_target_of_onnx_runtime():
    rows = [contestant("ours:int8", [10.0] * 10, 0.03), contestant("peer", [20.0] * 10, 0.03)]
    assert [check.passed for check in Table("vit-s", rows, "cpu").checks()] == [True] * 4
    slow = [contestant("ours:int8", [16.0] * 10, 0.03), contestant("peer", [20.0] * 10, 0.03)]
    assert not Table("vit-s", slow, "cpu").checks()[3].passed, "2.5x where 2.6x is wanted"
