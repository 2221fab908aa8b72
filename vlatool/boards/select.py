"""Which board: every way of running a policy on every board, held against what is wanted, with the reason in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from vlatool.errors import ProfileError
from vlatool.graph.workload import Workload
from vlatool.hardware.profile import Profile
from vlatool.latency_model.board import Candidate, Outcome, candidates, outcomes, power_limit, stored_quantization
from vlatool.latency_model.model import LatencyModel

STATES = ("fits", "may fit", "unknown", "no")
FIDELITY = ("float32", "bfloat16", "float16", "", "float8", "int8", "w8", "w4")
"""Precisions, that which changes the policy least first."""
OLDEST = (3, 8)
"""Systems with an older Python have a C library that no wheel of ONNX Runtime 1.23 loads with."""


@dataclass(frozen=True)
class Wants:
    """What a user asks for; None: anything.

    Args:
        hz: Inferences in a second; control ticks in a second when ``per_chunk``.
        latency_ms: Latency of one inference.
        watts: The board's limit, by its power mode.
        price: Price in US dollars.
        memory_gb: Memory of the board that the policy may take (10^9 bytes).
        battery_wh: Battery of the robot; only the battery life follows from it.
        robots, years, hours_a_day: Usage that the cost is computed for.
        kwh_price: US dollars.
        network_ms: Way to a cloud machine and back.
        precisions: Those that are allowed; all when empty.
        execute: Actions of one inference (a chunk) that are executed.
        per_chunk: Whether an inference may last as long as the actions before it: the loop goes on with them meanwhile.
    """

    hz: float | None = None
    latency_ms: float | None = None
    watts: float | None = None
    price: float | None = None
    memory_gb: float | None = None
    battery_wh: float | None = None
    robots: int = 1
    years: float = 3.0
    hours_a_day: float = 8.0
    kwh_price: float = 0.3
    network_ms: float = 40.0
    precisions: tuple[str, ...] = ()
    execute: int = 1
    per_chunk: bool = False

    @property
    def inference_hz(self) -> float | None:
        """Inferences in a second."""
        return self.hz / self.execute if self.hz and self.per_chunk else self.hz

    @property
    def limit_ms(self) -> float:
        """What one inference may take, by rate and latency; infinite without either."""
        by_rate = 1e3 / self.inference_hz if self.inference_hz else math.inf
        return min(by_rate, self.latency_ms or math.inf)


@dataclass(frozen=True)
class Choice:
    """A board with the best way of running the policy on it, or the nearest.

    Args:
        state: One of ``STATES``.
        outcome: None when it was ruled out before anything was computed.
        others: Further ways that were looked at on this board.
    """

    profile: Profile
    state: str
    outcome: Outcome | None
    reason: str
    others: tuple[Outcome, ...] = ()


def choose(boards: Iterable[Profile], load: Workload, model: LatencyModel, wants: Wants) -> list[Choice]:
    """Return a choice for each board, the best first; raises ProfileError when no board is left to look at."""
    choices: list[Choice] = []
    asked: dict[str, list[Candidate]] = {}
    profiles = {board.name: board for board in boards}
    if not profiles:
        raise ProfileError("No boards to choose from.", "leave --boards out, or look at: vlatool profiles list")
    for name, board in profiles.items():
        reason, ways = _before(board, load, wants)
        if reason:
            choices.append(Choice(board, "no", None, reason))
        else:
            asked[name] = ways
    flat = [way for ways in asked.values() for way in ways]
    answers = iter(outcomes(flat, load, model))
    for name, ways in asked.items():
        choices.append(_best(profiles[name], [next(answers) for _ in ways], wants))
    return sorted(choices, key=_rank)


def _rank(choice: Choice) -> tuple[int, bool, float, float]:
    outcome = choice.outcome
    cloud = choice.profile.price_usd_per_hour is not None
    energy = outcome.joules if outcome and outcome.latency.known else math.inf
    return STATES.index(choice.state), cloud, choice.profile.price_usd.value, energy


def _before(board: Profile, load: Workload, wants: Wants) -> tuple[str, list[Candidate]]:
    """Return why a board is ruled out by what it is, and the ways that are left otherwise."""
    price = board.price_usd.value
    if wants.price is not None and price > wants.price and board.price_usd_per_hour is None:
        return f"costs {price:,.0f} dollars, more than {wants.price:,.0f}", []
    pythons = [tuple(map(int, release.python.split("."))) for release in board.software]
    if pythons and max(pythons) < OLDEST:
        newest = ".".join(map(str, max(pythons)))
        return f"its newest system brings Python {newest}, and the runtime needs 3.10", []
    modes = list(board.modes)
    if wants.watts is not None:
        least = min(power_limit(Candidate(board, mode, board.engine)) for mode in modes)
        modes = [mode for mode in modes if power_limit(Candidate(board, mode, board.engine)) <= wants.watts]
        if not modes:
            return f"its lowest power mode takes up to {least:g} W, more than {wants.watts:g} W", []
    ways = candidates(board, load, modes)
    if not ways:
        return f"no engine of it runs this bundle, whose graphs are {stored_quantization(load)}", []
    if wants.precisions:
        stored = stored_quantization(load)
        ways = [way for way in ways if (way.precision or stored) in wants.precisions]
        if not ways:
            return f"it has no engine for {' or '.join(wants.precisions)}", []
    return "", ways


def usable_mb(board: Profile, wants: Wants) -> float:
    """Return what a policy may take of the board's memory, in MB (10^6 bytes)."""
    usable = board.usable_memory_gb.value
    return 1e3 * (min(usable, wants.memory_gb) if wants.memory_gb else usable)


def state_of(outcome: Outcome, wants: Wants) -> str:
    """Say how an outcome stands to what is wanted: the 90th percentile must keep the limit to fit for certain."""
    usable = usable_mb(outcome.candidate.profile, wants)
    if outcome.memory_mb[1] > usable:
        return "no"
    if not outcome.latency.known:
        return "unknown"
    if outcome.latency.ms > wants.limit_ms or outcome.memory_mb[0] > usable:
        return "no"
    return "may fit" if outcome.latency.high > wants.limit_ms or outcome.memory_mb[2] > usable else "fits"


def _best(board: Profile, results: Sequence[Outcome], wants: Wants) -> Choice:
    """Return the way of running the policy on a board that changes it least among those that fit, or the nearest."""
    states = {id(outcome): state_of(outcome, wants) for outcome in results}

    def rank(outcome: Outcome) -> tuple[int, float, float]:
        state = STATES.index(states[id(outcome)])
        limit, fidelity = power_limit(outcome.candidate), FIDELITY.index(outcome.candidate.precision)
        if states[id(outcome)] == "fits":
            return state, float(fidelity), limit
        known = outcome.latency.known and outcome.memory_mb[0] <= usable_mb(board, wants)
        return state, outcome.latency.high if known else math.inf, limit

    ordered = sorted(results, key=rank)
    best, *others = ordered
    return Choice(board, states[id(best)], best, _reason(best, states[id(best)], ordered, wants), tuple(others))


def _reason(best: Outcome, state: str, results: Sequence[Outcome], wants: Wants) -> str:
    usable = usable_mb(best.candidate.profile, wants)
    limit = wants.limit_ms
    low, middle, high = (value / 1e3 for value in (best.memory_mb[1], best.memory_mb[0], best.memory_mb[2]))
    if best.memory_mb[1] > usable:
        least = min(results, key=lambda outcome: outcome.memory_mb[1])
        return f"needs {least.memory_mb[1] / 1e3:.1f} GB at {_word(least)}, {usable / 1e3:.1f} usable"
    if not best.latency.known:
        return f"{best.latency.why} ({_word(best)}, {best.candidate.engine})"
    if state == "fits":
        return _headroom(best, results, wants)
    if best.memory_mb[0] > usable:
        return f"needs about {middle:.1f} GB ({low:.1f}-{high:.1f}), {usable / 1e3:.1f} usable"
    if best.latency.ms > limit:
        return f"about {_ms(best.latency.ms)} > {_ms(limit)} even at {_word(best)}"
    if best.latency.high > limit:
        return (
            f"90th percentile {_ms(best.latency.high)} > {_ms(limit)} at {_word(best)}, median {_ms(best.latency.ms)}"
        )
    return f"memory may be too small: about {middle:.1f} GB ({low:.1f}-{high:.1f}), {usable / 1e3:.1f} usable"


def _headroom(best: Outcome, results: Sequence[Outcome], wants: Wants) -> str:
    """Say what the chosen precision leaves over, and why a more faithful one is not taken."""
    rank = FIDELITY.index(best.candidate.precision)
    better = [other for other in results if FIDELITY.index(other.candidate.precision) < rank and other.latency.known]
    faithful = ""
    if better:
        nearest = min(better, key=lambda other: other.latency.high)
        if nearest.latency.high > wants.limit_ms:
            faithful = f"; {_word(nearest)} takes up to {_ms(nearest.latency.high)}"
    if math.isinf(wants.limit_ms):
        return f"fits at {_word(best)}{faithful}"
    return f"{wants.limit_ms / best.latency.high:.1f} times as fast as needed at {_word(best)}{faithful}"


def _word(outcome: Outcome) -> str:
    return outcome.candidate.precision or "the bundle's precision"


def _ms(value: float) -> str:
    return f"{value:.0f} ms" if value >= 10 else f"{value:.2g} ms"


@dataclass(frozen=True)
class Cost:
    """What a board costs over its life.

    Args:
        owned: US dollars for all robots: boards and energy.
        cloud: US dollars for the same inferences on a rented machine; NaN where none can do them.
        break_even_hours: Hours of work after which the board is cheaper than the rent; NaN without.
        battery_hours: How long the robot's battery drives the board alone; NaN without a battery.
        average_watts: Power at the wall, idle times included.
    """

    owned: float
    cloud: float
    break_even_hours: float
    battery_hours: float
    average_watts: float


def cost(choice: Choice, wants: Wants, cloud: Choice | None = None) -> Cost:
    """Return the cost of a choice, beside a cloud machine's when there is one."""
    board, outcome = choice.profile, choice.outcome
    nothing = math.nan
    if outcome is None or not outcome.latency.known or board.price_usd_per_hour is not None:
        return Cost(nothing, nothing, nothing, nothing, nothing)
    rate = wants.inference_hz or 1e3 / outcome.latency.ms
    average = outcome.average_watts(rate)
    hours = wants.years * 365 * wants.hours_a_day
    energy = average / 1e3 * wants.kwh_price
    owned = wants.robots * (board.price_usd.value + hours * energy)
    rent = _rent(cloud, rate)
    saved = rent - energy
    return Cost(
        owned, wants.robots * hours * rent, board.price_usd.value / saved if saved > 0 else math.nan,
        wants.battery_wh / average if wants.battery_wh else nothing, average,
    )  # fmt: skip


def _rent(cloud: Choice | None, rate: float) -> float:
    """Return the rent for an hour of one robot's inferences: as many robots share a machine as it has time for."""
    if (
        cloud is None
        or cloud.outcome is None
        or not cloud.outcome.latency.known
        or not cloud.profile.price_usd_per_hour
    ):
        return math.nan
    busy = rate * cloud.outcome.latency.ms / 1e3
    return cloud.profile.price_usd_per_hour.value * max(busy, 1 / max(1.0, math.floor(1 / busy)))


def in_the_cloud(wants: Wants) -> Wants:
    """Return what is left of the wishes for a rented machine: no watts, no price, and the network's time is gone."""
    limit = wants.limit_ms - wants.network_ms
    return replace(wants, hz=None, latency_ms=max(limit, 1e-3), watts=None, price=None, memory_gb=None)
