"""Show a report: on a terminal, as one HTML page, as Markdown for a pull request, as JSON.

Every section is one file (``sections``), every format another one, with one class that has ``render(report) -> str``
(``formats``), and between them is a document of blocks (``document``). A number never changes its nature on the way:
what was measured and what was predicted stand in separate sections, each with its place, its count and its interval.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from vlatool import registry
from vlatool.files.user_files import atomic_file
from vlatool.report import Report

FILES = {"json": "report.json", "html": "report.html", "markdown": "report.md"}

__all__ = ["FILES", "Renderer", "render", "write_reports"]


class Renderer(Protocol):
    """What a file of ``formats`` defines."""

    def render(self, report: Report) -> str:
        """Return the report as text of the format."""
        ...


def render(report: Report, format: str) -> str:
    """Return the report as text in one of the formats.

    Raises:
        UsageError: when there is no such format; names the nearest one.
        MissingExtra: for HTML, when jinja2 is not installed.

    Example:
        >>> render(Report("benchmark", "Latency"), "markdown").splitlines()[0]
        '### ℹ️ INFO: Latency'
    """
    renderer: Renderer = registry.load("render", format)()
    return renderer.render(report)


def write_reports(report: Report, directory: Path) -> list[Path]:
    """Write ``report.json``, ``report.html`` and ``report.md`` into a directory, which is made when absent.

    Returns:
        The paths that were written.

    Raises:
        OSError: when the directory cannot be made or written to; ``writing`` makes a sentence of it.
    """
    texts = {directory / name: render(report, format) for format, name in FILES.items()}
    directory.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        with atomic_file(path) as draft:
            draft.write_text(text, encoding="utf-8")
    return list(texts)
