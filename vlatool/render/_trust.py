"""Whether a measurement can be trusted, and why: the same words in every format."""

from __future__ import annotations

from vlatool.render._format import plain
from vlatool.report import EFFECTS, Report

SENTENCES = {
    "": "",
    "valid": "The measurement is valid.",
    "suspect": "The measurement is suspect: its numbers may be wrong.",
    "invalid": "The measurement is invalid: do not use its numbers.",
}


def sentence(report: Report) -> str:
    """Return whether the measurement can be trusted, as a sentence; nothing when nobody judged it."""
    judgement = SENTENCES[report.validity]
    return judgement.replace("measurement", "comparison") if report.kind == "compare" else judgement


def reasons(report: Report) -> list[tuple[str, str, str]]:
    """Return (effect, reason, remedy) of each finding, the worst first; sentences, the remedy may be empty."""
    worst_first = sorted(report.findings, key=lambda finding: -EFFECTS.index(finding.effect))
    remedies = (plain(finding.remedy).strip() for finding in worst_first)
    return [
        (finding.effect, _ended(plain(finding.reason)), _ended(f"Remedy: {remedy}") if remedy else "")
        for finding, remedy in zip(worst_first, remedies, strict=True)
    ]


def _ended(text: str) -> str:
    text = text.strip()
    return text if not text or text[-1] in ".!?" else f"{text}."
