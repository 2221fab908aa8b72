"""The tables of ``hwselect`` in HTML."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.render._boards import HEADS, cells, costs, way
from vlatool.render._sections import safe, section
from vlatool.report import Report, Row

SUB = (
    "Latency is the median of one inference, with the interval that holds 80 % of measurements; memory is that of the "
    "process, of what the board has to give; W is drawn while it infers, J is spent on one inference."
)


def boards_section(heading: str, rows: Sequence[Row]) -> str:
    """Return the table of one state, each board's reason below its numbers."""
    heads = "".join(f'<th scope="col"{_n(place)}>{safe(name)}</th>' for place, name in enumerate(HEADS))
    body = []
    for row in rows:
        first, *others = cells(row)
        numbers = "".join(f"<td{_n(place)}>{safe(text)}</td>" for place, text in enumerate(others, 1))
        body.append(f'<tr class="{row.role}"><th scope="row">{safe(first)}</th>{numbers}</tr>')
        engine = way(row).get("engine", "")
        told = f"{engine}: {row.reason}" if engine else row.reason
        body.append(f'<tr class="more"><td></td><td colspan="{len(HEADS) - 1}" class="sub">{safe(told)}</td></tr>')
    table = f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(body)}</tbody></table>"
    return section(heading, f'<div class="scroll">{table}</div>', SUB if "Fits" in heading else "", "predicted")


def cost_section(report: Report) -> str:
    """Return what each board costs over its life, and the rent for the same work."""
    titles, found = costs(report)
    if not found:
        return ""
    heads = "".join(f'<th scope="col"{_n(3 * place)}>{safe(name)}</th>' for place, name in enumerate(titles))
    lines = []
    for first, *others in found:
        numbers = "".join(f'<td class="n">{safe(text)}</td>' for text in others)
        lines.append(f'<tr><th scope="row">{safe(first)}</th>{numbers}</tr>')
    table = f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    sub = "W while it infers, and on average at the rate asked for. Owned: boards and energy for all robots over the "
    sub += "years asked for. Cloud: the rent of a machine for the same work. Pays: hours after which owning is less."
    return section("Power and cost", f'<div class="scroll">{table}</div>', sub, "predicted")


def _n(place: int) -> str:
    return ' class="n"' if place > 2 else ""
