"""Which rows dominate which: two processes of one graph never do, whatever the noise of their median."""

from pathlib import Path

import pytest
from _copies import without_copies
from _interleave import CLOCKS, Contestant
from _ours import MARK, SEARCH, bundle_of
from _report import Table
from _workload import Workload

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


def measured(name: str, milliseconds: float, error: float = 0.03, engine: str = "ort_cpu", **dtypes: float):
    row = contestant(name, [milliseconds] * 10, error)
    row.engine, row.dtypes = engine, dtypes or {"int8": 1.0}
    return row


LIMITS = [measured("limit: ort_cpu float32", 20.0, float32=1.0), measured("limit: ort_cpu int8", 10.0, int8=1.0)]


def checks(rows, instruction_set: str = "AVX2", macs: float = 2**31) -> dict[str, bool]:
    found = Table("vit-s", [*rows, *LIMITS], "cpu", macs, instruction_set).checks()
    return {check.text[:3]: check.passed for check in found}


def test_a_set_without_vnni_has_targets_of_its_own():
    rows = [measured("ours:static-int8", 24.0), measured("ort:static", 30.0)]
    assert checks(rows)["(b)"], "1.67x is what AVX2 can do"
    assert not checks(rows, "AVX512_CORE_VNNI")["(b)"]
    assert not checks([measured("ours:static-int8", 25.0), rows[1]])["(b)"]


def test_vnni_of_256_bits_gains_less_than_that_of_512():
    rows = [measured("ours:static-int8", 15.0), measured("ort:static", 30.0)]
    assert checks(rows, "AVX2_VNNI")["(b)"], "2.67x"
    assert not checks(rows, "AVX512_CORE_VNNI")["(b)"]
    assert not checks([measured("ours:static-int8", 15.5), rows[1]], "AVX2_VNNI")["(b)"]


def test_the_share_of_the_reachable_adds_up_what_each_dtype_would_take():
    half = measured("ours:static-int8", 40.0, int8=0.5, float32=0.5)
    table = Table("vit-s", [half, measured("ort:static", 60.0), *LIMITS], "cpu", 2**31)
    assert table.reached(half) == pytest.approx((10.0 + 20.0) / 40.0)
    assert table.reached(measured("torch", 40.0, engine="", float32=1.0)) is None
    assert {row.name for row in table.limits} == {limit.name for limit in LIMITS}
    assert checks([half, measured("ort:static", 60.0)])["(f)"]
    assert not checks([measured("ours:static-int8", 30.0), measured("ort:static", 60.0)])["(f)"], "20 of 30 ms"


def test_the_search_must_deliver_what_one_command_does():
    peer, single = measured("ort:static", 60.0), measured("ours:static-int8, mse, attention", 20.0)
    ahead = measured("ours:optimize, relative_error 0.04", 20.2)
    assert checks([peer, single, ahead])["(e)"]
    assert not checks([peer, single, measured("ours:optimize, relative_error 0.04", 21.0)])["(e)"]
    assert not checks([peer, single, measured("ours:optimize, relative_error 0.04", 19.0, error=0.05)])["(e)"]
    assert "(e)" not in checks([peer, single])


def test_what_an_option_did_not_change_is_timed_once(tmp_path: Path):
    workload = Workload("vit-s", tmp_path)
    graphs = {
        "static-int8": b"one",
        "static-int8, attention": b"one",
        "static-int8, elementwise": b"two",
        SEARCH: b"one",
    }
    for name, graph in graphs.items():
        place = bundle_of(workload, name) / "graphs"
        place.mkdir(parents=True)
        (place / "main.onnx").write_bytes(graph)
    rows = [Contestant(f"{MARK}{name}", "") for name in graphs]
    rows += [
        Contestant("ort:fp32", ""),
        Contestant(f"{MARK}mine (given)", ""),
        Contestant(f"{MARK}bfloat16", "", "gone"),
    ]
    kept = [row.name for row in without_copies(workload, rows)]
    assert kept == [row.name for row in rows if row.name != f"{MARK}static-int8, attention"]
