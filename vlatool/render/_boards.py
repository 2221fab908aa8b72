"""The boards of ``hwselect``: one table for each state, reasons below; price against latency as a chart."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from vlatool.render._format import number
from vlatool.render._labels import Mark, labels
from vlatool.render._svg import Axis, Canvas, axis_for
from vlatool.report import Measurement, Report, Row

KIND = "hwselect"
STATES = {
    "fits": "Fits",
    "may fit": "May fit: the interval crosses a limit",
    "unknown": "Unknown: no ground for a prediction",
    "no": "Ruled out",
}
NOTHING = "–"
HEADS = ("board", "mode", "dtype", "ms (80 %)", "GB of", "USD")
COST = ("board", "W", "mean W", "J", "battery h", "owned $", "cloud $", "pays h")


def way(row: Row) -> dict[str, str]:
    """Return how a board is driven: state, power mode, engine, precision."""
    found = row.details.get("way") or [{}]
    return {key: str(value) for key, value in found[0].items()}


def by_state(report: Report) -> list[tuple[str, list[Row]]]:
    """Return (heading, rows) of each state that occurs."""
    groups = {state: [row for row in report.rows if way(row).get("state") == state] for state in STATES}
    return [(STATES[state], rows) for state, rows in groups.items() if rows]


def cells(row: Row) -> list[str]:
    """Return the cells of a row under ``HEADS``."""
    driven = way(row)
    dtype = driven.get("precision") or ("as it is" if driven.get("engine") else NOTHING)
    latency, memory, usable = (row.get(name, "predicted") for name in ("latency_p50", "memory", "usable_memory"))
    return [
        row.name, driven.get("power mode", ""), dtype, _spread(latency),
        _of(memory, usable), _money(row.get("price", "predicted")),
    ]  # fmt: skip


def costs(report: Report) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of what power and money each board takes; columns that say nothing are left out."""
    body = []
    for row in report.rows:
        if row.get("owned_cost", "predicted") is None:
            continue
        power = [_value(row, name) for name in ("watts", "average_watts", "energy", "battery_life")]
        money = [_money(row.get(name, "predicted")) for name in ("owned_cost", "cloud_cost")]
        body.append([row.name, *power, *money, _value(row, "break_even")])
    shown = [place for place in range(len(COST)) if any(line[place] != NOTHING for line in body)]
    return [COST[place] for place in shown], [[line[place] for place in shown] for line in body]


def reasons(rows: Iterable[Row]) -> list[str]:
    """Return ``board, engine: reason`` for each row."""
    found = []
    for row in rows:
        engine = way(row).get("engine", "")
        found.append(f"{row.name}{f', {engine}' if engine else ''}: {row.reason}")
    return found


def _spread(item: Measurement | None) -> str:
    if item is None or not item.known:
        return NOTHING
    ends = f" ({_short(item.low)}–{_short(item.high)})" if item.low is not None and item.high is not None else ""
    return f"{_short(item.value)}{ends}"


def _short(value: float | None) -> str:
    if value is None:
        return NOTHING
    return f"{value:.0f}" if value >= 100 else number(value, 2)


def _of(memory: Measurement | None, usable: Measurement | None) -> str:
    if memory is None or usable is None:
        return NOTHING
    return f"{memory.value / 1e3:.2g}/{usable.value / 1e3:.3g}"


def _value(row: Row, name: str) -> str:
    item = row.get(name, "predicted")
    return number(item.value, 2) if item is not None and item.known else NOTHING


def _money(item: Measurement | None) -> str:
    return f"{item.value:,.0f}" if item is not None and item.known else NOTHING


def chart(report: Report, width: int) -> str:
    """Return price against latency of every board with a prediction; the limit, and the front that nothing beats."""
    found = [(row, item) for row in report.rows if (item := row.get("latency_p50", "predicted")) and item.known]
    height, frame = 380 if width > 500 else 330, (58.0, 26.0, width - 14.0, (380 if width > 500 else 330) - 40.0)
    left, top, right, bottom = frame
    prices = [row.get("price", "predicted") for row, _ in found]
    across = axis_for(
        [end for _, item in found for end in (item.low or item.value, item.high or item.value)], left, right
    )
    up = axis_for([price.value for price in prices if price], bottom, top)
    spoken = "; ".join(
        f"{row.name}: {_spread(item)} ms, {_money(row.get('price', 'predicted'))} dollars" for row, item in found
    )
    marks = [_mark(row, item, across, up) for row, item in found]
    limit = limit_ms(report)
    ends = [(item.low or item.value, item.high or item.value) for _, item in found]
    lines = [(across(low), mark.y - 1, across(high), mark.y + 1) for mark, (low, high) in zip(marks, ends, strict=True)]
    lines += [(across(limit) - 1, top, across(limit) + 1, bottom)] if across.holds(limit) else []
    named = labels(marks, (left, top - 10, width - 4.0, bottom), lines, width * 0.5)
    canvas = Canvas(f"boards-{width}", width, height + round(named.height), "Price against predicted latency", spoken)
    for value in up.ticks(6):
        canvas.line(left, up(value), right, up(value), "grid")
        canvas.text(left - 6, up(value) + 4, f"{value:,.0f}", "tick", "end")
    canvas.across(across, bottom, top, 8 if width > 500 else 4)
    canvas.text(0, 12, "US dollars", "note")
    canvas.text(right, bottom + 32, "predicted latency of one inference, ms (80 % interval)", "note", "end")
    if across.holds(limit):
        canvas.line(across(limit), top, across(limit), bottom, "limit")
        canvas.text(across(limit) - 5, bottom - 8, f"limit {limit:g} ms", "limit-text", "end")
    _front(canvas, found, across, up)
    for row, item in found:
        _board(canvas, row, item, across, up)
    named.draw(canvas, height)
    return canvas.svg()


def limit_ms(report: Report) -> float:
    """Return what one inference may take."""
    rate, own = report.limits.get("hz"), report.limits.get("latency_ms")
    ticks = report.limits.get("ticks_an_inference", 1)
    return min(1e3 * ticks / rate if rate else math.inf, own or math.inf)


def _front(canvas: Canvas, found: Sequence[tuple[Row, Measurement]], across: Axis, up: Axis) -> None:
    best: list[tuple[float, float]] = []
    for row, item in sorted(found, key=lambda pair: pair[1].value):
        price = row.get("price", "predicted")
        if price is not None and (not best or price.value < best[-1][1]):
            best.append((item.value, price.value))
    if len(best) > 1:
        canvas.steps([(across(x), up(y)) for x, y in best], "front")


def _mark(row: Row, item: Measurement, across: Axis, up: Axis) -> Mark:
    price = row.get("price", "predicted")
    css = {"chosen": "s-chosen", "within": "s1", "subject": "s3", "outside": "s-base"}[row.role]
    return Mark(across(item.value), up(price.value if price else 0.0), row.name, css, 5.0)


def _board(canvas: Canvas, row: Row, item: Measurement, across: Axis, up: Axis) -> None:
    mark = _mark(row, item, across, up)
    x, y, css = mark.x, mark.y, mark.css
    if item.low is not None and item.high is not None:
        canvas.line(across(item.low), y, across(item.high), y, f"whisker {css}")
    tip = f"{row.name}: {_spread(item)} ms; {row.reason}"
    if row.role == "outside":
        canvas.add("circle", f"hollow {css}", tip, cx=x, cy=y, r=4)
    else:
        canvas.add("circle", f"dot {css}", tip, cx=x, cy=y, r=5 if row.role == "chosen" else 4)
