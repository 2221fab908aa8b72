"""The boards of ``hwselect``: one table for each state with the reasons, price against latency, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from vlatool.measures import Quantity, resources
from vlatool.measures.latency import LATENCY_P50
from vlatool.measures.tables import WAY
from vlatool.render._format import number, plain
from vlatool.render._view import ranks_boards
from vlatool.render.cells import texts
from vlatool.render.charts.scatter import Bound, Point, Scatter
from vlatool.render.document import ABSENT, Chart, Column, Line, Section, Table
from vlatool.report import Measurement, Report, Row

STATES = {
    "fits": "Fits",
    "may fit": "May fit: the interval crosses a limit",
    "unknown": "Unknown: no ground for a prediction",
    "no": "Ruled out",
}
HEADS = ("board", "mode", "dtype", "latency, ms (80 %)", "GB of", "USD")
COST = ("board", "W", "mean W", "J", "battery h", "owned $", "cloud $", "pays h")
WHERE = "Predicted, not measured"
ABOUT = (
    "Latency is the median of one inference, with the interval that holds 80 % of measurements; memory is that of the "
    "process, of what the board has to give."
)
ABOUT_COST = (
    "W while it infers, and on average at the rate asked for; J is spent on one inference. Owned: boards and energy "
    "for all robots over the years asked for. Cloud: the rent of a machine for the same work. Pays: hours after which "
    "owning is less."
)
HELP = (
    "Down and to the left is better. Lines through the points are 80 % intervals; the dotted line joins the boards "
    "that no other beats in both. Ringed: chosen. Filled: fits or may fit. Hollow: ruled out."
)
TINTS = {"chosen": "s-chosen", "within": "s1", "subject": "s3", "outside": "s-base"}


class Boards:
    """What is predicted for each board."""

    def build(self, report: Report) -> Iterator[Section]:
        """Return the sections of a report that ranks boards; nothing for another one."""
        if not ranks_boards(report):
            return
        for state, heading in STATES.items():
            if rows := [row for row in report.rows if way(row).get("state") == state]:
                about = ABOUT if state == "fits" else ""
                yield Section(heading, (board_table(rows),), 20, "predicted", WHERE, about)
        if plot := scatter(report):
            yield Section("Price against latency", (Chart(plot.draw, HELP),), 30, "predicted", WHERE)
        if table := cost_table(report.rows):
            yield Section("Power and cost", (table,), 40, "predicted", WHERE, ABOUT_COST)


def way(row: Row) -> dict[str, str]:
    """Return how a board is driven: state, power mode, engine, precision."""
    records = row.details.get(WAY) or [{}]
    return {key: str(value) for key, value in records[0].items()}


def board_table(rows: Sequence[Row]) -> Table:
    """Return the boards of one state, each with its reason."""
    lines = (
        Line(texts(map(plain, cells(row))), plain(way(row).get("engine", "")), plain(row.reason), row.role == "chosen")
        for row in rows
    )
    return Table(tuple(Column(head, index > 2) for index, head in enumerate(HEADS)), tuple(lines), style="cards")


def cells(row: Row) -> list[str]:
    """Return the cells of a row under ``HEADS``."""
    driven = way(row)
    dtype = driven.get("precision") or ("as it is" if driven.get("engine") else ABSENT)
    latency, memory, usable = (
        row.get(each, "predicted") for each in (LATENCY_P50, resources.MEMORY, resources.USABLE_MEMORY)
    )
    return [
        row.name, driven.get("power mode", ""), dtype, _spread(latency),
        _of(memory, usable), _money(row.get(resources.PRICE, "predicted")),
    ]  # fmt: skip


def cost_table(rows: Sequence[Row]) -> Table | None:
    """Return what power and money each board takes; columns that say nothing are left out."""
    body = []
    for row in rows:
        if row.get(resources.OWNED_COST, "predicted") is None:
            continue
        power = [
            _value(row, each)
            for each in (resources.WATTS, resources.AVERAGE_WATTS, resources.ENERGY, resources.BATTERY_LIFE)
        ]
        money = [_money(row.get(each, "predicted")) for each in (resources.OWNED_COST, resources.CLOUD_COST)]
        body.append([plain(row.name), *power, *money, _value(row, resources.BREAK_EVEN)])
    shown = [index for index in range(len(COST)) if any(line[index] != ABSENT for line in body)]
    lines = tuple(Line(texts(line[index] for index in shown)) for line in body)
    return Table(tuple(Column(COST[index], index > 0) for index in shown), lines) if lines else None


def _spread(item: Measurement | None) -> str:
    if item is None or not item.known:
        return ABSENT
    ends = f" ({_short(item.low)}–{_short(item.high)})" if item.low is not None and item.high is not None else ""
    return f"{_short(item.value)}{ends}"


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else number(value, 2)


def _of(memory: Measurement | None, usable: Measurement | None) -> str:
    if memory is None or usable is None:
        return ABSENT
    return f"{memory.value / 1e3:.2g}/{usable.value / 1e3:.3g}"


def _value(row: Row, quantity: Quantity) -> str:
    item = row.get(quantity, "predicted")
    return number(item.value, 2) if item is not None and item.known else ABSENT


def _money(item: Measurement | None) -> str:
    return f"{item.value:,.0f}" if item is not None and item.known else ABSENT


def limit_ms(report: Report) -> float:
    """Return what one inference may take."""
    rate, own = report.limits.get("hz"), report.limits.get("latency_ms")
    ticks = report.limits.get("ticks_an_inference", 1)
    return min(1e3 * ticks / rate if rate else math.inf, own or math.inf)


def scatter(report: Report) -> Scatter | None:
    """Return price against latency of every board with a prediction; None when there are fewer than two."""
    points = [
        Point(
            row.name, TINTS[row.role], item, price, f"{row.name}: {_spread(item)} ms; {row.reason}",
            {"chosen": "ringed", "outside": "hollow"}.get(row.role, "dot"),
        )
        for row in report.rows
        if (item := row.get(LATENCY_P50, "predicted")) and item.known
        and (price := row.get(resources.PRICE, "predicted"))
    ]  # fmt: skip
    if len(points) < 2:
        return None
    limit = limit_ms(report)
    return Scatter(
        "boards",
        "Price against predicted latency",
        tuple(points),
        "predicted latency, ms (80 % interval)",
        "US dollars",
        "; ".join(f"{point.name}: {_spread(point.x)} ms, {_money(point.y)} dollars" for point in points),
        Bound(limit, f"limit {limit:g} ms") if math.isfinite(limit) else None,
        smaller=True,
    )
