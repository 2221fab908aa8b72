"""Which candidate keeps to the limits, and by how much each other misses them: in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from vlatool.measures import Quantity, actions, quantity_of
from vlatool.measures.latency import LATENCY_P50, LATENCY_P90
from vlatool.measures.resources import MEMORY, PEAK_RSS
from vlatool.measures.success import SUCCESS, SUCCESS_DROP
from vlatool.optimize.budget import Budget, distance_of
from vlatool.optimize.moves import Held, judge_moves
from vlatool.optimize.recipe import Limits
from vlatool.report import Measurement, Row

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

TOLERANCE = 1e-12
AGAINST_FLOAT32 = "against float32"
FROM_FLOAT32 = (actions.RELATIVE_ERROR, actions.DISAGREEMENT, actions.ERROR_BASELINE, actions.GRIPPER_FLIPS_BASELINE)
"""What is a distance from float32 itself, beside the errors by element."""
RECORDED_DROPS = {actions.AGREEMENT_DROP: "agreement with the expert", actions.ERROR_INCREASE: "action error"}
DROPS = {SUCCESS_DROP: "success", **RECORDED_DROPS}
"""Which accuracy decides, and what of it in words: the closed loop where there is one, else recorded observations."""


@dataclass(frozen=True)
class Judged:
    """A row, held against the limits.

    Args:
        row: The row with its role and the reason for it in words.
        within: Whether it keeps to every limit.
        drop: Accuracy lost against float32, a share; NaN when it is not known.
        miss: By how much it misses the limits, as a multiple of them (0 when within, infinite when unknown).
        sentences: What to tell a person, when it is the chosen one.
    """

    row: Row
    within: bool
    drop: float
    miss: float = 0.0
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def judge(row: Row, baseline: Row, limits: Limits, profile: Profile | None, on_board: bool = False) -> Judged:
    """Hold a candidate's row against the limits.

    Args:
        profile: The board; None for this host.
        on_board: Whether this host is that board, so that its own latency decides.

    Returns:
        The row with its role (``within`` / ``outside``; the baseline keeps its own) and the reason in words.
    """
    is_baseline = row is baseline
    drops, from_float32 = ([], False) if is_baseline else _recorded_drops(row, baseline)
    row = replace(row, measurements=(*row.measurements, *drops))
    decisive = _decisive(row, limits, from_float32)
    judges = (_judge_rate, _judge_memory)
    rate = Held.all(judge_one(row, limits, profile, on_board) for judge_one in judges)
    if is_baseline:
        reason = "; ".join(miss.words for miss in rate.missed) or "the reference"
        return Judged(replace(row, reason=reason), not rate.missed, 0.0, rate.miss, (), rate.warnings)
    if row.reason and baseline.get(SUCCESS) is not None and row.get(SUCCESS) is None:
        return Judged(row, False, math.nan, math.inf)  # its episodes were not played, and the reason says why
    found = Held.all((_judge_accuracy(row, decisive, limits), _judge_distance(row, decisive, limits),
                      judge_moves(row, limits)))  # fmt: skip
    missed = (*found.missed, *rate.missed)
    kept = f"{_drop_words(decisive)}, within {_allowed(limits, decisive)}" if decisive else ""
    reason = "; ".join(miss.words for miss in missed) or kept
    row = replace(row, role="outside" if missed else "within", reason=reason)
    warnings = (*rate.warnings, *(() if missed else found.warnings))
    drop = decisive.measured.value if decisive else math.nan
    return Judged(row, not missed, drop, found.miss + rate.miss, (), warnings)


@dataclass(frozen=True)
class _Decisive:
    """The number that decides about accuracy.

    Args:
        measured: drop, or the metric that was named.
        from_float32: whether it is a distance from float32's own answers, since nobody says what is right.
    """

    measured: Measurement
    from_float32: bool = False


def _decisive(row: Row, limits: Limits, from_float32: bool) -> _Decisive | None:
    drop = next((measured for drop in DROPS if (measured := row.get(drop)) is not None), None)
    measured = Budget(limits.metric, 0.0).of(row) if limits.metric else drop
    return (
        None if measured is None else _Decisive(measured, from_float32 and quantity_of(measured.name) in RECORDED_DROPS)
    )


def _judge_accuracy(row: Row, decisive: _Decisive | None, limits: Limits) -> Held:
    if decisive is None or not (drop := decisive.measured).known:
        reason = "its accuracy is unmeasured: the policy brings neither an environment nor evaluation data"
        return Held.missing(math.inf, reason)
    if limits.metric:
        allowed = limits.max_metric or 0.0
        if drop.value <= allowed:
            return Held()
        over_limit = f"{_drop_words(decisive)}, allowed {_allowed(limits, decisive)}"
        return Held.missing(drop.value / max(allowed, 1e-9) - 1, over_limit)
    over = drop.value - limits.max_drop
    if over > TOLERANCE:
        words = f"{_drop_words(decisive)}, {_points(over)} over the budget"
        return Held.missing(over / max(limits.max_drop, 0.001), words)
    high = drop.high or 0.0
    if high <= limits.max_drop:
        return Held()
    return Held(
        warnings=(
            f"{row.name}: the drop could be as large as {_points(high)} ({drop.samples} paired samples cannot exclude "
            "it); more episodes would narrow it: --episodes",
        )
    )


def _judge_distance(row: Row, decisive: _Decisive | None, limits: Limits) -> Held:
    """Judge the distance from float32's own actions, which a drop against the expert or of success does not show."""
    distance = distance_of(row)
    if distance is None or (decisive is not None and _is_distance(decisive)):
        return Held()
    if not distance.known:
        return Held.missing(math.inf, f"its distance from float32 is unknown: {distance.note}")
    if distance.value <= limits.max_distance:
        return Held()
    reason = f"{_distance_words(distance)}, allowed {_percent(limits.max_distance)} (--max-distance)"
    return Held.missing(distance.value / max(limits.max_distance, 1e-9) - 1, reason)


def _is_distance(decisive: _Decisive) -> bool:
    """Return whether what decides is a distance from float32 itself, so that the limit on it is the user's."""
    name = decisive.measured.name
    distance = quantity_of(name) in FROM_FLOAT32 or actions.ERROR_BASELINE_OF.pattern.part(name) is not None
    return decisive.from_float32 or distance


def _distance_words(distance: Measurement) -> str:
    if distance.name == actions.DISAGREEMENT.name:
        return f"{_percent(distance.value)} of the answers are not those of float32"
    return f"the action differs from float32's by {_percent(distance.value)} of its standard deviation"


def _percent(share: float) -> str:
    return f"{100 * share:,.0f} %" if share >= 10 else f"{100 * share:.3g} %"


def _recorded_drops(row: Row, baseline: Row) -> tuple[list[Measurement], bool]:
    """Return the drops on recorded observations, more is worse; and whether they are distances from float32 itself."""
    drops: list[tuple[Quantity, float, Measurement]] = []
    for quantity, drop, sign in (
        (actions.AGREEMENT_EXPERT, actions.AGREEMENT_DROP, -1.0),
        (actions.ERROR_EXPERT, actions.ERROR_INCREASE, 1.0),
    ):
        own, base = row.get(quantity), baseline.get(quantity)
        if own is not None and base is not None and own.known:
            drops.append((drop, sign * (own.value - base.value), own))
    from_float32 = not drops
    if from_float32:
        agreement, error = row.get(actions.AGREEMENT_BASELINE), row.get(actions.ERROR_BASELINE)
        if agreement is not None:
            drops = [(actions.AGREEMENT_DROP, 1.0 - agreement.value, agreement)]
        elif error is not None:
            drops = [(actions.ERROR_INCREASE, error.value, error)]
    note = AGAINST_FLOAT32 if from_float32 else "recorded observations"
    known = [(drop, value, own) for drop, value, own in drops if own.known]
    measured = [drop.measurement(value, where=own.where, samples=own.samples, note=note) for drop, value, own in known]
    return measured, from_float32 and bool(measured)


def _judge_memory(row: Row, limits: Limits, profile: Profile | None, on_board: bool) -> Held:
    """Judge the memory: by what a fresh process took here, or by the prediction for another board."""
    if limits.max_memory_mb is None:
        return Held()
    measured = profile is None or on_board
    memory = row.get(PEAK_RSS) if measured else row.get(MEMORY, "predicted")
    if memory is None or not memory.known:
        return Held(warnings=(f"{row.name}: its memory is not known, so {limits.max_memory_mb:g} MB is unjudged",))
    if memory.value <= limits.max_memory_mb:
        return Held()
    reason = f"needs {memory.value:.4g} MB{'' if measured else ' (predicted)'} > {limits.max_memory_mb:g} MB"
    return Held.missing(memory.value / limits.max_memory_mb - 1, reason)


def _judge_rate(row: Row, limits: Limits, profile: Profile | None, on_board: bool) -> Held:
    """Judge the latency: on the board by what was measured, elsewhere by the prediction for the board."""
    budget_ms = limits.latency_ms
    if budget_ms is None:
        return Held()
    if on_board or profile is None:
        latency = row.get(LATENCY_P90) or row.get(LATENCY_P50)
        p90 = latency.value if latency else math.inf
        late = f"p90 latency {p90:.3g} ms > {budget_ms:.3g} ms"
        return Held.missing(p90 / budget_ms - 1, late) if p90 > budget_ms else Held()
    predicted = row.get(LATENCY_P50, "predicted")
    if predicted is None or not predicted.known:
        unjudged = f"{row.name}: no latency can be predicted for {profile.name}, so {_rate(limits)} is unjudged"
        return Held(warnings=(unjudged,))
    low, high = predicted.low or predicted.value, predicted.high or predicted.value
    reason = f"predicted {predicted.value:.3g} ms ({low:.3g}-{high:.3g}) on {profile.name}"
    reason += f", {_rate(limits)} needs {budget_ms:.3g} ms"
    if low > budget_ms:
        return Held.missing(predicted.value / budget_ms - 1, reason)
    if high > budget_ms:
        return Held(warnings=(f"{row.name}: {reason}: too close to call, measure on the board",))
    return Held()


def _rate(limits: Limits) -> str:
    slow = limits.hz is None or (limits.max_latency_ms is not None and limits.max_latency_ms < 1000.0 / limits.hz)
    return "--max-latency-ms" if slow else f"{limits.hz:g} Hz"


def _allowed(limits: Limits, decisive: _Decisive) -> str:
    if not limits.metric:
        return _points(limits.max_drop)
    unit = decisive.measured.unit
    return f"{limits.max_metric:.4g}{'' if unit == '1' else ' ' + unit}"


def _drop_words(decisive: _Decisive) -> str:
    drop = decisive.measured
    name = DROPS.get(quantity_of(drop.name))
    if name is None:
        return f"{drop.name} is {drop.value:.4g}{'' if drop.unit == '1' else ' ' + drop.unit}"
    if decisive.from_float32:
        return _distance_words(drop if drop.name == actions.ERROR_INCREASE.name else actions.DISAGREEMENT.relabel(drop))
    if drop.name == actions.ERROR_INCREASE.name:
        return f"{name} {'rises' if drop.value >= 0 else 'falls'} by {_points(abs(drop.value))}"
    verb = "drops" if drop.value > 0 else ("is unchanged" if drop.value == 0 else "rises")
    note = f" ({drop.note})" if drop.note and drop.name == SUCCESS_DROP.name else ""
    return f"{name} {verb}{'' if drop.value == 0 else f' by {_points(abs(drop.value))}'}{note}"


def _points(share: float) -> str:
    points = f"{100 * share:.3g}"
    return f"{points} point" + ("" if points == "1" else "s")
