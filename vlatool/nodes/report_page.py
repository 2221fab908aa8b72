"""The HTML report of a run: one page without scripts, with the path from above, states, latencies and settings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from vlatool.errors import OutputError
from vlatool.files.printable import amount, printable
from vlatool.files.user_files import write_own_file
from vlatool.nodes.session import RunResult
from vlatool.nodes.trace import Trace, TracePoint, phases
from vlatool.render.charts.run import bands, over_time, path_from_above
from vlatool.render.charts.svg import Canvas

WIDTHS = (996, 366)
"""Pixels of a drawing on a wide page and on a narrow one."""
STYLE = Path(__file__).parent.parent / "render/formats/page.css"
MAX_STATES = 8
MAX_LINES = 6
"""Notes and inputs of which a line is drawn, each in a panel of its own kind."""


def write_page(path: Path, result: RunResult, trace: Trace) -> None:
    """Write the report; raises OutputError where the file exists already or cannot be written."""
    try:
        write_own_file(path, page(result, trace), force=False, comment="<!-- {} -->")
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written: {error.strerror}.", "free some space, or check the path"
        ) from error


def page(result: RunResult, trace: Trace) -> str:
    """Return the report as HTML."""
    found, points = result.to_dict(), trace.points
    title = f"{result.about.controller}, {found['steps']} steps in {found['seconds']:.1f} s"
    sections = [*_sections(trace), _table("Times of the steps", _times(found)), _table("Topics", _topics(result)),
                _table("Settings", _settings(result))]  # fmt: skip
    lead = "".join(f"<p>{_text(line)}</p>" for line in _summary(found, points))
    head = f"<title>{_text(title)}</title><style>{STYLE.read_text(encoding='utf-8')}</style>"
    top = '<!doctype html><html lang="en"><meta charset="utf-8">'
    top += '<meta name="viewport" content="width=device-width,initial-scale=1">'
    over = f'<p class="over">a run of {_text(result.about.node)}, vlatool {_text(result.about.version)}</p>'
    return f"{top}{head}<body><main>{over}<h1>{_text(title)}</h1>{lead}{''.join(sections)}</main></body></html>\n"


def _text(content: Any) -> str:
    return escape(printable(str(content)))


def _summary(found: Mapping[str, Any], points: Sequence[TracePoint]) -> Iterator[str]:
    yield f"It ended with the status: {found['status'] or 'none'}."
    words = Counter((point.status.split() or ["no status"])[0] for point in points)
    if points:
        yield (
            "Statuses: " + ", ".join(f"{word} {count / len(points):.0%}" for word, count in words.most_common(8)) + "."
        )
    if found["skipped"]:
        yield f"{amount(found['skipped'], 'step')} left out, because the one before took too long."
    if any(found["overwritten"].values()):
        many = ", ".join(f"{name} {count}" for name, count in found["overwritten"].items() if count)
        yield f"Messages that came faster than the controller reads: {many}."
    if found["lost_records"] or found["failure"]:
        yield f"The records of the steps are not whole: {found['failure'] or found['lost_records']}."
    for fault in found["faults"]:
        yield f"On the bus, {amount(fault['count'], 'time')}: {fault['error']}"


def _sections(trace: Trace) -> Iterator[str]:
    """Yield the sections with drawings, those that there is something for."""
    points = trace.points
    if not points:
        return
    path = [point.position for point in points if point.position is not None]
    if path:
        marks = list(_changes(points))
        yield _section("Path from above", "The ring is the start, the dot the end; circles are changes of the status.",
                       [path_from_above(path, marks, width) for width in WIDTHS])  # fmt: skip
    rows = _rows(trace)
    yield _section("Statuses and levels", "What held when; the first word of a status.",
                   [bands(rows, points[-1].time_s, width) for width in WIDTHS])  # fmt: skip
    panels = _panels(points)
    yield _section("Latencies and speeds", "Of each step.", [over_time(panels, width) for width in WIDTHS])


def _rows(trace: Trace) -> dict[str, list[tuple[float, float, str]]]:
    """Return what held when: the status, its details where they are few words, levels and other states."""
    points = trace.points
    rows = {"status": list(phases(points))}
    details = [point._replace(status=point.status.partition(" ")[2]) for point in points]
    words = {point.status for point in details}
    if 1 < len(words) <= MAX_STATES and not any(letter.isdigit() for word in words for letter in word):
        rows["in detail"] = list(phases(details, whole=True))
    rows |= {key: list(phases(points, key)) for key in _state_notes(points)}
    return rows | {topic: _levels(trace, heard) for topic, heard in trace.levels.items() if heard}


def _levels(trace: Trace, heard: Sequence[tuple[float, str]]) -> list[tuple[float, float, str]]:
    """Return from when to when another node was at each level, in seconds from the first step."""
    end_s = trace.points[-1].time_s
    times = [min(max(0.0, moment - trace.first_s), end_s) for moment, _ in heard]
    return [(began, ended, word) for began, ended, (_, word) in zip(times, [*times[1:], end_s], heard, strict=True)]


def _changes(points: Sequence[TracePoint]) -> Iterator[tuple[float, float, str]]:
    last = ""
    for point in points:
        word = (point.status.split() or [""])[0]
        if word != last and point.position is not None:
            yield (*point.position, f"{point.status} at {point.time_s:.1f} s")
        last = word


def _state_notes(points: Sequence[TracePoint]) -> list[str]:
    """Return the notes that are states: texts, and levels."""
    names = {name: value for point in points for name, value in point.notes.items()}
    return [name for name, value in names.items() if isinstance(value, str) or name == "level"][:MAX_LINES]


def _panels(points: Sequence[TracePoint]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    def line(values: Iterator[tuple[float, float | None]]) -> list[tuple[float, float]]:
        return [(time, value) for time, value in values if value is not None and math.isfinite(value)]

    panels: dict[str, dict[str, list[tuple[float, float]]]] = {
        "time of a step, ms": {
            "controller": line((point.time_s, point.compute_ms) for point in points),
            "around it": line((point.time_s, point.total_ms - point.compute_ms) for point in points),
            "late": line((point.time_s, point.late_ms) for point in points),
        }
    }
    half_ms = points[-1].time_s * 500
    inputs = list(dict.fromkeys(name for point in points for name in point.ages_ms if point.ages_ms[name] <= half_ms))
    inputs = [name for name in inputs if points[-1].ages_ms.get(name, 0.0) <= half_ms][:MAX_LINES]
    if inputs:
        panels["age of the newest message, ms"] = {
            name: line((point.time_s, point.ages_ms.get(name)) for point in points) for name in inputs
        }
    if any(point.speeds for point in points):
        for index, name in enumerate(("speed commanded, m/s", "turn commanded, rad/s")):
            values = ((point.time_s, point.speeds[index] if point.speeds else None) for point in points)
            panels[name] = {name: line(values)}
    numbers = list(dict.fromkeys(name for point in points for name, value in point.notes.items()
                                 if not isinstance(value, str) and name != "level"))[:MAX_LINES]  # fmt: skip
    for name in numbers:
        values = ((point.time_s, float(point.notes[name]) if name in point.notes else None) for point in points)
        panels[name] = {name: line(values)}
    return {name: lines for name, lines in panels.items() if any(lines.values())}


def _section(title: str, words: str, canvases: Sequence[Canvas]) -> str:
    drawn = "".join(f'<div class="{css}">{canvas.svg()}</div>'
                    for css, canvas in zip(("wide", "narrow"), canvases, strict=True))  # fmt: skip
    return f'<section><h2>{_text(title)}</h2><p class="sub">{_text(words)}</p>{drawn}</section>'


def _table(title: str, rows: Sequence[Sequence[str]]) -> str:
    body = "".join(f"<tr><th>{_text(first)}</th>{''.join(f'<td>{_text(cell)}</td>' for cell in rest)}</tr>"
                   for first, *rest in rows)  # fmt: skip
    return f'<section><h2>{_text(title)}</h2><div class="scroll"><table>{body}</table></div></section>' if rows else ""


def _times(found: Mapping[str, Any]) -> list[list[str]]:
    names = {"late_ms": "late", "compute_ms": "controller", "overhead_ms": "inboxes, checks, sending"}
    return [[words, f"p50 {found[name]['p50']:.3f} ms", f"p99 {found[name]['p99']:.3f} ms"]
            for name, words in names.items() if found[name]["samples"]]  # fmt: skip


def _topics(result: RunResult) -> list[list[str]]:
    return [[name, topic] for name, topic in result.about.topics.items()]


def _settings(result: RunResult) -> list[list[str]]:
    about = result.about
    more = {"bundle": about.policy, "robot": about.robot}
    return [[name, str(value)] for name, value in {**about.settings, **more}.items() if value not in ("", None)]
