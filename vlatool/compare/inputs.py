"""Reports that ``compare`` can put side by side, and what they are called there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vlatool.errors import DataError, UsageError
from vlatool.report import REPORT, Report, read_report

COMPARABLE = ("benchmark", "optimize", "evaluate", "compare")


def read_reports(paths: Sequence[Path]) -> list[Report]:
    """Read reports that can be compared.

    Raises:
        DataError: when one cannot be read, or has no rows; names the file.
        UsageError: when one is given twice, is of a kind that measures nothing, or shares no number with the others.
    """
    seen: dict[Path, Path] = {}
    for path in paths:
        candidates = (path, path / REPORT, path / "reports" / REPORT)
        file = next((candidate for candidate in candidates if candidate.is_file()), path).resolve()
        if file in seen:
            raise UsageError(
                f"{seen[file]} and {path} are the same report; compare takes each once.", "name each report once"
            )
        seen[file] = path
    reports = [_read(path) for path in paths]
    for path, report in zip(paths, reports, strict=True):
        if report.kind not in COMPARABLE:
            raise UsageError(
                f"{path} is a report of the kind {report.kind!r}, which compare cannot put beside another; "
                f"allowed: {', '.join(COMPARABLE)}.",
                "name reports of one of these kinds",
            )
        if not report.rows:
            raise DataError(
                f"The report {path} has no rows, so there is nothing to compare.",
                "measure again, and name the new report",
            )
    first = _measured(reports[0])
    for path, report in zip(paths[1:], reports[1:], strict=True):
        if not first & _measured(report):
            raise UsageError(
                f"{paths[0]} ({reports[0].kind}) and {path} ({report.kind}) have no measurement in common.",
                "compare reports of the same kind",
            )
    return reports


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return the shortest endings of the paths that tell them apart; ``report.json`` and ``reports`` name nothing."""
    parts = [list(path.absolute().parts) for path in paths]
    for names in parts:
        if len(names) > 1 and names[-1] == REPORT:
            names.pop()
        if len(names) > 1 and names[-1] == "reports":
            names.pop()
        names[-1] = names[-1].removesuffix(".json") or names[-1]
    for depth in range(1, max(map(len, parts)) + 1):
        endings = ["/".join(names[-depth:]).replace("//", "/") for names in parts]
        if len(set(endings)) == len(endings):
            return endings
    return [str(path) for path in paths]


def _measured(report: Report) -> set[str]:
    return {item.name for row in report.rows for item in row.measurements if item.origin == "measured" and item.known}


def _read(path: Path) -> Report:
    try:
        return read_report(path)
    except DataError as error:
        if str(path) in error.message:
            raise
        raise DataError(f"{path}: {error.message}", error.fix) from error
