"""What an evaluation says of a variant beside its success: its worst task, how it moves, what disturbs it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vlatool.accuracy.disturbance_drops import worst_record
from vlatool.accuracy.motion_comparison import pairs_above_none, worst_task
from vlatool.bundle.bundle import Bundle
from vlatool.measures.latency import LATENCY_IN_THE_LOOP
from vlatool.measures.motion import ADDED_MEAN, RATIO, STEPS_RATIO
from vlatool.measures.success import WORST_TASK_DROP
from vlatool.report import Measurement, Row

MIN_RATIO = 1.005
"""Ratio below which two decimals say 1.00, and nothing is worth a sentence."""
FEWEST_ADDED = 6
"""Pairs in which the variant alone has something, so that an exact two-sided sign test gives less than 5 %."""


def found_wrong(bundle: Bundle) -> tuple[str, ...]:
    """Return why ``load`` refuses a bundle, in sentences: what a stage found to be wrong with it."""
    found = bundle.manifest.findings
    return tuple(f"load refuses this bundle ({finding['name']}): {finding['message']}" for finding in found)


def sentences(rows: Sequence[Row], board: str) -> Iterator[str]:
    """Yield sentences on the last row.

    Args:
        rows: The baseline, where there is one, and the variant.
        board: What latencies in the loop are predicted for; measured here when empty.
    """
    row = rows[-1]
    worst, steps = row.get(WORST_TASK_DROP), row.get(STEPS_RATIO)
    if worst and worst.value > 0:
        yield f"The task that loses most is {worst_task(worst)}: {100 * worst.value:.3g} points."
    changed = {metric: item for metric, item in RATIO.members(row).items() if item is not steps}
    if rougher := {metric: item for metric, item in changed.items() if _is_more(item)}:
        words = (f"{metric.replace('_', ' ')} {_times(item.value)}" for metric, item in rougher.items())
        yield f"Where both succeed, more than the baseline's: {', '.join(words)}."
    if new := list(_added(rows)):
        yield f"Where both succeed, the baseline has none of these: {', '.join(new)}."
    if steps and _is_more(steps):
        yield f"Over all episodes, it needs {_times(steps.value)} the steps."
    yield from _disturbed(row)
    if latencies := {one.name: item.value for one in rows for origin in ("measured", "predicted")
                     if (item := one.get(LATENCY_IN_THE_LOOP, origin))}:  # fmt: skip
        late = ", ".join(f"{name} {ms:.3g} ms" for name, ms in latencies.items())
        where = f"predicted for {board}" if board else "measured here"
        yield f"Actions come as late as inferences take ({where}): {late}."


def _added(rows: Sequence[Row]) -> Iterator[str]:
    """Yield what the baseline has nothing of, and the variant in so many pairs that chance does not explain it."""
    if len(rows) < 2:
        return
    added = ADDED_MEAN.members(rows[-1])
    for name, (some, count) in pairs_above_none(rows[0], rows[-1], added).items():
        if some >= FEWEST_ADDED:
            yield f"{name.replace('_', ' ')} (in {some} of {count} episodes, {added[name].value:.3g} on average)"


def _disturbed(row: Row) -> Iterator[str]:
    """Yield a sentence on the disturbance that costs most, beside the baseline where there is one."""
    if (found := worst_record(row)) is None:
        return
    worst, name = found
    drop = worst.get("drop")
    if drop is None:
        yield f"It succeeds least under {name}: {worst['success']:.1%}."
    elif drop > 0:
        yield f"It loses most beside the baseline under {name}: {worst['success']:.1%} succeed, " \
              f"{100 * drop:.3g} points fewer than of the baseline."  # fmt: skip
    else:
        yield "Under no disturbance does it succeed less often than the baseline."


def _is_more(ratio: Measurement) -> bool:
    """Say whether a ratio is shown to be above 1, by as much as is printed."""
    return ratio.value >= MIN_RATIO and (ratio.low or 0.0) > 1


def _times(ratio: float) -> str:
    return f"{ratio:.2f}x" if ratio < 10 else f"{ratio:.3g}x"
