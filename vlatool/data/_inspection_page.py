"""The page of an inspection: its table, and a contact sheet with pictures of each camera."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.data._inspection import Column, Inspection
from vlatool.data._sampling import sampled_rows
from vlatool.data._steps import Steps
from vlatool.errors import require
from vlatool.files.printable import amount, printable
from vlatool.files.rows import Rows

PICTURES = 8
"""Pictures of each camera on the contact sheet."""
WIDTH = 160
"""Of a picture on the contact sheet, in pixels."""
STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:76rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse}td,th{padding:.2rem .8rem .2rem 0;text-align:left;border-bottom:1px solid #8884}"
    "figure{display:inline-block;margin:0 .4rem .4rem 0}figcaption{font-size:.8em}:root{color-scheme:light dark}"
)


def inspection_page(inspection: Inspection, steps: Steps) -> str:
    """Return the page as HTML; the pictures are in it.

    Raises:
        DataError: when a picture cannot be read.
        MissingExtra: when Pillow is not installed.
    """
    title = escape(printable(f"{inspection.path}: {inspection.format}"))
    lines = [f"<h1>{title}</h1>", *(f"<p>{escape(printable(line))}</p>" for line in inspection_lines(inspection)[1:3])]
    lines += [f"<p>⚠ {escape(printable(sentence))}</p>" for sentence in inspection.findings]
    lines += ["<table><tr><th>column</th><th>type</th><th>shape</th><th>range</th></tr>"]
    lines += [_row(column) for column in inspection.columns]
    lines += ["</table>", *_contact_sheet(steps)]
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    return f"{head}<body>{''.join(lines)}</body></html>\n"


def inspection_lines(inspection: Inspection) -> list[str]:
    """Return an inspection as lines of text."""
    lengths = np.array(inspection.lengths)
    spread = f"{lengths.min()} to {amount(lengths.max(), 'step')} each, {np.median(lengths):g} in the middle"
    measured = "no time stamps" if inspection.measured_hz is None else f"{inspection.measured_hz:.3g} Hz by time stamps"
    named = f"{inspection.hz:g} Hz by name, " if inspection.hz else ""
    tasks = f", {amount(inspection.tasks, 'task')}" if inspection.tasks else ""
    lines = [
        f"{inspection.path}  {inspection.format}",
        f"  episodes   {inspection.episodes}, {amount(inspection.steps, 'step')}{tasks}: {spread}",
        f"  rate       {named}{measured}",
    ]
    lines += [f"  column     {_text(column)}" for column in inspection.columns]
    return lines + [f"  warning    {sentence}" for sentence in inspection.findings]


def _text(column: Column) -> str:
    shape = "x".join(map(str, column.shape))
    ends = "" if column.low is None else f"  {column.low:.4g} to {column.high:.4g}"
    return f"{column.name}: {column.dtype}{f' {shape}' if shape else ''}{ends}"


def _row(column: Column) -> str:
    ends = "" if column.low is None else f"{column.low:.4g} to {column.high:.4g}"
    cells = (column.name, column.dtype, "x".join(map(str, column.shape)), ends)
    return f"<tr>{''.join(f'<td>{escape(printable(cell))}</td>' for cell in cells)}</tr>"


def _contact_sheet(steps: Steps) -> Iterator[str]:
    rows = sampled_rows(steps.episodes, PICTURES, steps.tasks).tolist()
    for name, values in steps.columns.items():
        if values.ndim == 4 and values.shape[-1] in (1, 3, 4) and values.dtype == np.uint8:
            yield f"<h2>{escape(printable(name))}</h2>"
            for row in rows:
                yield _figure(values, row, f"episode {int(steps.episodes[row])}, row {row}")


def _figure(values: NDArray[Any] | Rows, row: int, caption: str) -> str:
    library: Any = require("PIL.Image", "data")
    pixels = np.asarray(values[row])
    picture = library.fromarray(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels[:, :, :3])
    picture.thumbnail((WIDTH, WIDTH))
    stream = io.BytesIO()
    picture.save(stream, "JPEG", quality=80)
    coded = base64.b64encode(stream.getvalue()).decode()
    image = (
        f'<img width="{picture.width}" height="{picture.height}" src="data:image/jpeg;base64,{coded}" alt="{caption}">'
    )
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
