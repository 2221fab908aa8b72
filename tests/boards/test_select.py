from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from vlatool.boards.select import Choice, Wants, choose, cost, in_the_cloud, state_of
from vlatool.errors import ProfileError
from vlatool.graph.workload import GraphWorkload, Workload
from vlatool.hardware.profile import Profile, load_profile
from vlatool.latency_model.board import Candidate, outcomes
from vlatool.latency_model.model import LatencyModel

Load = Callable[..., Workload]
PI = load_profile("raspberry-pi-5")
ORIN = load_profile("jetson-orin-nano")
CLOUD = load_profile("h100-80gb")


@pytest.fixture
def chosen(certain: LatencyModel, load: Load) -> Callable[..., Choice]:
    """Choose for one board."""

    def choose_one(board: Profile = PI, work: Workload | None = None, **wants: object) -> Choice:
        return choose([board], work or load(), certain, Wants(**wants))[0]  # type: ignore[arg-type]

    return choose_one


@pytest.fixture
def slow(certain: LatencyModel, load: Load) -> tuple[float, float]:
    """Median and high end of the Raspberry Pi in float32, ms."""
    latency = outcomes([Candidate(PI, "default", "ort_cpu", "float32")], load(), certain)[0].latency
    return latency.ms, latency.high


# ---- states


def test_what_keeps_the_limit_fits_and_says_by_how_much(chosen: Callable[..., Choice]) -> None:
    found = chosen(latency_ms=1000.0)
    assert found.state == "fits"
    assert found.outcome is not None
    times = 1000 / found.outcome.latency.high
    assert found.reason == f"{times:.1f} times as fast as needed at float32"


def test_without_a_limit_it_fits_at_the_most_faithful_precision(chosen: Callable[..., Choice]) -> None:
    assert chosen().reason == "fits at float32"


def test_a_faster_precision_is_taken_where_float32_is_too_slow(
    chosen: Callable[..., Choice], slow: tuple[float, float]
) -> None:
    found = chosen(latency_ms=0.9 * slow[1])
    assert found.state == "fits"
    assert found.outcome is not None
    assert found.outcome.candidate.precision != "float32"
    assert f"; float32 takes up to {slow[1]:.0f} ms" in found.reason
    assert len(found.others) == 3


def test_an_interval_that_crosses_the_limit_may_fit(chosen: Callable[..., Choice], slow: tuple[float, float]) -> None:
    middle, high = slow
    found = chosen(latency_ms=(middle + high) / 2, precisions=("float32",))
    assert found.state == "may fit"
    assert found.reason == (
        f"90th percentile {high:.0f} ms > {(middle + high) / 2:.0f} ms at float32, median {middle:.0f} ms"
    )


def test_what_is_too_slow_names_both_numbers(chosen: Callable[..., Choice], slow: tuple[float, float]) -> None:
    found = chosen(latency_ms=slow[0] / 2, precisions=("float32",))
    assert found.state == "no"
    assert found.reason == f"about {slow[0]:.0f} ms > {slow[0] / 2:.0f} ms even at float32"


def test_rate_and_latency_both_limit() -> None:
    assert Wants(hz=10).limit_ms == 100
    assert Wants(hz=10, latency_ms=30).limit_ms == 30
    assert Wants(hz=50, latency_ms=30).limit_ms == 20
    assert Wants().limit_ms == math.inf


def test_an_inference_for_each_chunk_may_last_as_long_as_its_actions() -> None:
    assert (Wants(hz=10, execute=4).inference_hz, Wants(hz=10, execute=4).limit_ms) == (10, 100)
    wants = Wants(hz=10, execute=4, per_chunk=True)
    assert (wants.inference_hz, wants.limit_ms) == (2.5, 400)
    assert replace(wants, latency_ms=30).limit_ms == 30
    assert replace(wants, hz=None).limit_ms == math.inf


def test_seven_billion_weights_do_not_fit_a_small_board(chosen: Callable[..., Choice], load: Load) -> None:
    found = chosen(ORIN, load(gmacs=7000.0, weights_m=7000.0), precisions=("float16",))
    assert found.state == "no"
    assert found.reason.startswith("needs 1")
    assert found.reason.endswith("GB at float16, 5.5 usable")


def test_memory_that_may_not_suffice_says_so(chosen: Callable[..., Choice], load: Load) -> None:
    work = load(gmacs=1.0, weights_m=200.0)
    found = chosen(PI, work, memory_gb=1.5, precisions=("float32",))
    assert found.outcome is not None
    middle, low, high = (each / 1e3 for each in found.outcome.memory_mb)
    assert low < middle < 1.5 < high
    assert found.state == "may fit"
    assert found.reason == f"memory may be too small: about {middle:.1f} GB ({low:.1f}-{high:.1f}), 1.5 usable"
    found = chosen(PI, work, memory_gb=(low + middle) / 2, precisions=("float32",))
    assert found.state == "no"
    assert found.reason.startswith(f"needs about {middle:.1f} GB ({low:.1f}-{high:.1f})")


def test_a_policy_may_not_take_more_than_the_board_has(chosen: Callable[..., Choice], load: Load) -> None:
    large = load(gmacs=7.0, weights_m=3000.0)
    assert chosen(PI, large, memory_gb=500.0, precisions=("float32",)).state == "no"


def test_a_policy_without_static_shapes_is_unknown(chosen: Callable[..., Choice]) -> None:
    found = chosen(work=Workload({"m": GraphWorkload({}, 1, unknown=("proj",))}, {"m": 1}))
    assert found.state == "unknown"
    assert "1 layers have no static shape, for example m/proj" in found.reason
    assert "ort_cpu" in found.reason


def test_a_board_that_cannot_be_predicted_but_lacks_memory_is_ruled_out(chosen: Callable[..., Choice]) -> None:
    huge = GraphWorkload({}, 1, weights=60_000_000_000, weight_bytes=240_000_000_000, unknown=("proj",))
    assert chosen(work=Workload({"m": huge}, {"m": 1})).state == "no"


# ---- what rules a board out before anything is predicted


@pytest.mark.parametrize(
    ("wants", "reason"),
    [
        ({"price": 1.0}, "costs 399 dollars, more than 1"),
        ({"watts": 1.0}, "its lowest power mode takes up to 7 W, more than 1 W"),
        ({"precisions": ("float8", "bfloat16")}, "it has no engine for float8 or bfloat16"),
    ],
)
def test_what_rules_a_board_out_is_said(chosen: Callable[..., Choice], wants: dict[str, object], reason: str) -> None:
    found = chosen(ORIN, **wants)
    assert (found.state, found.outcome, found.reason) == ("no", None, reason)


def test_only_modes_within_the_watts_are_looked_at(chosen: Callable[..., Choice]) -> None:
    found = chosen(ORIN, watts=10.0)
    assert found.outcome is not None
    assert {each.candidate.mode for each in (found.outcome, *found.others)} == {"7W"}


def test_an_old_system_is_ruled_out(chosen: Callable[..., Choice]) -> None:
    assert chosen(load_profile("jetson-nano")).reason.startswith("its newest system brings Python 3.6")


def test_a_bundle_in_a_precision_that_no_engine_runs(chosen: Callable[..., Choice], load: Load) -> None:
    found = chosen(PI, load(precision="float16"))
    assert found.reason == "no engine of it runs this bundle, whose graphs are float16"


def test_a_quantized_bundle_has_the_precision_that_it_is_stored_in(chosen: Callable[..., Choice], load: Load) -> None:
    assert chosen(PI, load(precision="int8"), precisions=("int8",)).state == "fits"
    assert chosen(PI, load(precision="int8"), precisions=("float32",)).state == "no"


def test_a_rented_machine_is_not_ruled_out_by_what_its_card_costs(chosen: Callable[..., Choice]) -> None:
    assert "dollars" not in chosen(CLOUD, price=10.0).reason


def test_nothing_to_choose_from_is_refused(certain: LatencyModel, load: Load) -> None:
    with pytest.raises(ProfileError, match="No boards to choose from"):
        choose([], load(), certain, Wants())


# ---- ranking


def test_boards_that_fit_come_first_and_the_cheapest_of_them(certain: LatencyModel, load: Load) -> None:
    pi, orin = PI, ORIN
    cheap = PI.model_copy(update={"name": "cheap", "price_usd": PI.price_usd.model_copy(update={"value": 1.0})})
    slow_one = PI.model_copy(
        update={"name": "slow", "usable_memory_gb": PI.memory_gb.model_copy(update={"value": 0.01})}
    )
    found = choose([CLOUD, slow_one, orin, pi, cheap], load(), certain, Wants(latency_ms=1000.0))
    order = [choice.profile.name for choice in found]
    assert order.index("cheap") < order.index(pi.name) < order.index(orin.name) < order.index("slow")
    assert [choice.state for choice in found if choice.profile.name in ("cheap", pi.name, orin.name)] == ["fits"] * 3
    fits = [choice.profile.name for choice in found if choice.state == "fits"]
    assert CLOUD.name not in fits[:-1], "a machine that is rented comes after those that are owned"


def test_a_board_named_twice_is_looked_at_once(certain: LatencyModel, load: Load) -> None:
    assert len(choose([PI, PI], load(), certain, Wants())) == 1


def test_of_equal_fidelity_the_mode_that_draws_least_is_taken(chosen: Callable[..., Choice]) -> None:
    found = chosen(ORIN, latency_ms=1000.0, precisions=("float16",))
    assert found.outcome is not None
    assert found.outcome.candidate.mode == "7W"


def test_every_state_is_one_of_four(certain: LatencyModel, load: Load, slow: tuple[float, float]) -> None:
    outcome = outcomes([Candidate(PI, "default", "ort_cpu", "float32")], load(), certain)[0]
    middle, high = slow
    for limit, state in ((high * 1.01, "fits"), (high * 0.99, "may fit"), (middle * 0.99, "no")):
        assert state_of(outcome, Wants(latency_ms=limit)) == state
    unknown = replace(outcome, latency=replace(outcome.latency, why="no ground"))
    assert state_of(unknown, Wants()) == "unknown"


# ---- cost


def test_owning_costs_the_board_and_its_energy(chosen: Callable[..., Choice]) -> None:
    wants = Wants(hz=2.0, robots=10, years=2.0, hours_a_day=5.0, kwh_price=0.4, battery_wh=50.0)
    choice = chosen(hz=2.0, precisions=("float32",))
    assert choice.outcome is not None
    busy = 2.0 * choice.outcome.latency.ms / 1e3
    assert busy < 1
    average = 4.5 + (choice.outcome.watts[0] - 4.5) * busy
    found = cost(choice, wants)
    assert found.average_watts == pytest.approx(average)
    assert found.battery_hours == pytest.approx(50 / average)
    assert found.owned == pytest.approx(10 * (PI.price_usd.value + 2 * 365 * 5 * average / 1000 * 0.4))
    assert math.isnan(found.cloud)
    assert math.isnan(found.break_even_hours)
    rarer = cost(choice, replace(wants, execute=4, per_chunk=True)).average_watts
    assert rarer == pytest.approx(4.5 + (choice.outcome.watts[0] - 4.5) * busy / 4)
    assert math.isnan(cost(choice, replace(wants, battery_wh=None)).battery_hours)


@pytest.fixture
def rented(certain: LatencyModel, load: Load) -> Choice:
    """A rented machine that takes 100 ms for an inference at 4 dollars an hour."""
    outcome = outcomes([Candidate(CLOUD, "default", "ort_tensorrt", "float16")], load(), certain)[0]
    outcome = replace(outcome, latency=replace(outcome.latency, ms=100.0, why=""))
    price = CLOUD.price_usd.model_copy(update={"value": 4.0})
    return Choice(CLOUD.model_copy(update={"price_usd_per_hour": price}), "fits", outcome, "")


@pytest.mark.parametrize(
    ("hz", "rent"),
    [(2.0, 4 / 5), (3.0, 4 / 3), (9.0, 4.0), (10.0, 4.0), (25.0, 10.0)],
    ids=["five-share", "three-share", "alone", "full", "two-and-a-half-machines"],
)
def test_as_many_robots_share_a_machine_as_it_has_time_for(
    chosen: Callable[..., Choice], rented: Choice, hz: float, rent: float
) -> None:
    wants = Wants(hz=hz, robots=3, years=1.0, hours_a_day=10.0, kwh_price=0.3)
    choice = chosen(ORIN, precisions=("float16",))
    found = cost(choice, wants, rented)
    assert found.cloud == pytest.approx(3 * 3650 * rent)
    energy = found.average_watts / 1000 * 0.3
    assert found.break_even_hours == pytest.approx(ORIN.price_usd.value / (rent - energy))


def test_a_board_that_never_pays_has_no_break_even(chosen: Callable[..., Choice], rented: Choice) -> None:
    found = cost(chosen(hz=2.0), Wants(hz=2.0, kwh_price=1e6), rented)
    assert math.isnan(found.break_even_hours)


def test_without_a_rate_the_board_works_all_the_time(chosen: Callable[..., Choice]) -> None:
    choice = chosen()
    assert choice.outcome is not None
    assert cost(choice, Wants()).average_watts == pytest.approx(choice.outcome.watts[0])


def test_what_cannot_be_had_has_no_cost(chosen: Callable[..., Choice], rented: Choice) -> None:
    for choice in (chosen(price=1.0), rented):
        assert all(math.isnan(value) for value in vars(cost(choice, Wants(hz=1.0), rented)).values())


def test_the_network_takes_its_time_from_a_rented_machine() -> None:
    found = in_the_cloud(Wants(hz=10, watts=5, price=5, memory_gb=1, network_ms=40, precisions=("int8",)))
    assert found.limit_ms == 60
    assert (found.watts, found.price, found.memory_gb, found.precisions) == (None, None, None, ("int8",))
    assert in_the_cloud(Wants(hz=50, network_ms=40)).limit_ms == 1e-3, "no machine is that fast"
    assert in_the_cloud(Wants()).limit_ms == math.inf
