"""Which candidate keeps to the limits, and by how much each other misses them: in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from vlatool.measures import actions
from vlatool.measures.latency import LATENCY_P50, LATENCY_P90
from vlatool.measures.resources import MEMORY, PEAK_RSS
from vlatool.measures.success import SUCCESS, SUCCESS_DROP
from vlatool.optimize.budget import Budget, distance_of
from vlatool.optimize.moves import judge_moves
from vlatool.optimize.recipe import Limits
from vlatool.report import Measurement, Row

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

TOLERANCE = 1e-12
AGAINST_FLOAT32 = "against float32"
FROM_FLOAT32 = {
    actions.RELATIVE_ERROR.name,
    actions.DISAGREEMENT.name,
    actions.ERROR_BASELINE.name,
    actions.GRIPPER_FLIPS_BASELINE.name,
}
"""The measurements that are distances from float32 themselves, beside the errors by element."""
DROPS = {
    SUCCESS_DROP: "success",
    actions.AGREEMENT_DROP: "agreement with the expert",
    actions.ERROR_INCREASE: "action error",
}
"""Which accuracy decides, and in words of what: the closed loop where there is one, else recorded observations."""


@dataclass(frozen=True)
class Judged:
    """A row, held against the limits.

    Args:
        row: The row with its role and the reason for it in words.
        within: Whether it keeps to every limit.
        drop: Accuracy lost against float32, a share; NaN when it is not known.
        miss: By how much it misses the limits, as a multiple of them (0 when within, infinite when unknown).
        sentences: What to tell a person, when it is the chosen one.
        warnings: What a person should know before trusting it.
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
        row: The candidate, or the baseline itself.
        baseline: The float32 row.
        limits: What was asked for.
        profile: The board; None for this host.
        on_board: Whether this host is that board, so that its own latency decides.

    Returns:
        The row with its role (``within`` / ``outside``; the baseline keeps its own) and the reason in words.
    """
    is_baseline = row is baseline
    row = _with_drop(row, baseline)
    decisive = next((measured for drop in DROPS if (measured := row.get(drop)) is not None), None)
    if limits.metric:
        decisive = Budget(limits.metric, 0.0).of(row)
    rate = _both(_judge_rate(row, limits, profile, on_board), _judge_memory(row, limits, profile, on_board))
    if is_baseline:
        reason = "; ".join(rate.reasons) or "the reference"
        return Judged(replace(row, reason=reason), not rate.reasons, 0.0, rate.miss, (), rate.warnings)
    if row.reason and baseline.get(SUCCESS) is not None and row.get(SUCCESS) is None:
        return Judged(row, False, math.nan, math.inf)  # its episodes were not played, and the reason says why
    accuracy = _both(_judge_accuracy(row, decisive, limits), _judge_distance(row, decisive, limits))
    moves = judge_moves(row, limits)
    accuracy = _both(accuracy, _Verdict(moves.reasons, moves.miss, moves.warnings))
    reasons = (*accuracy.reasons, *rate.reasons)
    kept = f"{_drop_words(decisive)}, within {_allowed(limits, decisive)}" if decisive else ""
    row = replace(row, role="outside" if reasons else "within", reason="; ".join(reasons) or kept)
    warnings = (*rate.warnings, *(() if reasons else accuracy.warnings))
    drop = decisive.value if decisive else math.nan
    return Judged(row, not reasons, drop, accuracy.miss + rate.miss, (), warnings)


@dataclass(frozen=True)
class _Verdict:
    """What one limit says: reasons against the row, by how much it misses, and reservations."""

    reasons: tuple[str, ...] = ()
    miss: float = 0.0
    warnings: tuple[str, ...] = ()


def _judge_accuracy(row: Row, drop: Measurement | None, limits: Limits) -> _Verdict:
    if drop is None or not drop.known:
        reason = "its accuracy is unmeasured: the policy brings neither an environment nor evaluation data"
        return _Verdict((reason,), math.inf)
    if limits.metric:
        allowed = limits.max_metric or 0.0
        if drop.value <= allowed:
            return _Verdict()
        over_limit = f"{_drop_words(drop)}, allowed {_allowed(limits, drop)}"
        return _Verdict((over_limit,), drop.value / max(allowed, 1e-9) - 1)
    over = drop.value - limits.max_drop
    if over > TOLERANCE:
        return _Verdict((f"{_drop_words(drop)}, {_points(over)} over the budget",), over / max(limits.max_drop, 0.001))
    high = drop.high or 0.0
    if high <= limits.max_drop:
        return _Verdict()
    return _Verdict(
        warnings=(
            f"{row.name}: the drop could be as large as {_points(high)} ({drop.samples} paired samples cannot exclude "
            "it); more episodes would narrow it: --episodes",
        )
    )


def _judge_distance(row: Row, decisive: Measurement | None, limits: Limits) -> _Verdict:
    """Judge the distance from float32's own actions, which a drop against the expert or of success does not show."""
    distance = distance_of(row)
    if distance is None or (decisive is not None and _is_distance(decisive)):
        return _Verdict()
    if not distance.known:
        return _Verdict((f"its distance from float32 is unknown: {distance.note}",), math.inf)
    if distance.value <= limits.max_distance:
        return _Verdict()
    reason = f"{_distance_words(distance)}, allowed {_percent(limits.max_distance)} (--max-distance)"
    return _Verdict((reason,), distance.value / max(limits.max_distance, 1e-9) - 1)


def _is_distance(decisive: Measurement) -> bool:
    """Say whether what decides is a distance from float32 itself, so that the limit on it is the user's."""
    known = decisive.name in FROM_FLOAT32 or actions.ERROR_BASELINE_OF.pattern.part(decisive.name) is not None
    return known or decisive.note == AGAINST_FLOAT32


def _distance_words(distance: Measurement) -> str:
    if distance.name == actions.DISAGREEMENT.name:
        return f"{_percent(distance.value)} of the answers are not those of float32"
    return f"the action differs from float32's by {_percent(distance.value)} of its standard deviation"


def _percent(share: float) -> str:
    return f"{100 * share:,.0f} %" if share >= 10 else f"{100 * share:.3g} %"


def _with_drop(row: Row, baseline: Row) -> Row:
    """Add the drop on recorded observations, in the direction in which more is worse."""
    if row is baseline:
        return row
    drops: list[Measurement] = []
    for quantity, drop, sign in (
        (actions.AGREEMENT_EXPERT, actions.AGREEMENT_DROP, -1.0),
        (actions.ERROR_EXPERT, actions.ERROR_INCREASE, 1.0),
    ):
        own, base = row.get(quantity), baseline.get(quantity)
        if own is not None and base is not None and own.known:
            value, note = sign * (own.value - base.value), "recorded observations"
            drops.append(drop.measurement(value, where=own.where, samples=own.samples, note=note))
    if not drops:
        agreement = row.get(actions.AGREEMENT_BASELINE)
        against = agreement or row.get(actions.ERROR_BASELINE)
        if against is not None and against.known:
            value, drop = (
                (1.0 - against.value, actions.AGREEMENT_DROP) if agreement else (against.value, actions.ERROR_INCREASE)
            )
            drops.append(drop.measurement(value, where=against.where, samples=against.samples, note=AGAINST_FLOAT32))
    return replace(row, measurements=(*row.measurements, *drops))


def _both(first: _Verdict, second: _Verdict) -> _Verdict:
    reasons, warnings = (*first.reasons, *second.reasons), (*first.warnings, *second.warnings)
    return _Verdict(reasons, first.miss + second.miss, warnings)


def _judge_memory(row: Row, limits: Limits, profile: Profile | None, on_board: bool) -> _Verdict:
    """Judge the memory: by what a fresh process took here, or by the prediction for another board."""
    if limits.max_memory_mb is None:
        return _Verdict()
    measured = profile is None or on_board
    memory = row.get(PEAK_RSS) if measured else row.get(MEMORY, "predicted")
    if memory is None or not memory.known:
        return _Verdict(warnings=(f"{row.name}: its memory is not known, so {limits.max_memory_mb:g} MB is unjudged",))
    if memory.value <= limits.max_memory_mb:
        return _Verdict()
    reason = f"needs {memory.value:.4g} MB{'' if measured else ' (predicted)'} > {limits.max_memory_mb:g} MB"
    return _Verdict((reason,), memory.value / limits.max_memory_mb - 1)


def _judge_rate(row: Row, limits: Limits, profile: Profile | None, on_board: bool) -> _Verdict:
    """Judge the latency: on the board by what was measured, elsewhere by the prediction for the board."""
    budget_ms = limits.latency_ms
    if budget_ms is None:
        return _Verdict()
    if on_board or profile is None:
        latency = row.get(LATENCY_P90) or row.get(LATENCY_P50)
        p90 = latency.value if latency else math.inf
        late = (f"p90 latency {p90:.3g} ms > {budget_ms:.3g} ms",)
        return _Verdict(late, p90 / budget_ms - 1) if p90 > budget_ms else _Verdict()
    predicted = row.get(LATENCY_P50, "predicted")
    if predicted is None or not predicted.known:
        unjudged = f"{row.name}: no latency can be predicted for {profile.name}, so {_rate(limits)} is unjudged"
        return _Verdict(warnings=(unjudged,))
    low, high = predicted.low or predicted.value, predicted.high or predicted.value
    reason = f"predicted {predicted.value:.3g} ms ({low:.3g}-{high:.3g}) on {profile.name}"
    reason += f", {_rate(limits)} needs {budget_ms:.3g} ms"
    if low > budget_ms:
        return _Verdict((reason,), predicted.value / budget_ms - 1)
    if high > budget_ms:
        return _Verdict(warnings=(f"{row.name}: {reason}: too close to call, measure on the board",))
    return _Verdict()


def _rate(limits: Limits) -> str:
    slow = limits.hz is None or (limits.max_latency_ms is not None and limits.max_latency_ms < 1000.0 / limits.hz)
    return "--max-latency-ms" if slow else f"{limits.hz:g} Hz"


def _allowed(limits: Limits, drop: Measurement) -> str:
    if not limits.metric:
        return _points(limits.max_drop)
    return f"{limits.max_metric:.4g}{'' if drop.unit == '1' else ' ' + drop.unit}"


def _drop_words(drop: Measurement) -> str:
    name = next((words for quantity, words in DROPS.items() if quantity.name == drop.name), "")
    if not name:
        return f"{drop.name} is {drop.value:.4g}{'' if drop.unit == '1' else ' ' + drop.unit}"
    if drop.note == AGAINST_FLOAT32:
        return _distance_words(drop if drop.name == actions.ERROR_INCREASE.name else actions.DISAGREEMENT.relabel(drop))
    if drop.name == actions.ERROR_INCREASE.name:
        return f"{name} {'rises' if drop.value >= 0 else 'falls'} by {_points(abs(drop.value))}"
    verb = "drops" if drop.value > 0 else ("is unchanged" if drop.value == 0 else "rises")
    note = f" ({drop.note})" if drop.note and drop.name == SUCCESS_DROP.name else ""
    return f"{name} {verb}{'' if drop.value == 0 else f' by {_points(abs(drop.value))}'}{note}"


def _points(share: float) -> str:
    points = f"{100 * share:.3g}"
    return f"{points} point" + ("" if points == "1" else "s")


def p50(row: Row, origin: str = "measured") -> float:
    """Return the median latency of a row in ms, infinite when it is not known."""
    latency = row.get(LATENCY_P50, origin)
    return latency.value if latency is not None and latency.known else math.inf
