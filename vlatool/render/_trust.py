"""Whether a measurement can be trusted, and why: the same words in every format."""

from __future__ import annotations

from vlatool.render._format import plain
from vlatool.report import EFFECTS, Finding, Report

MARKS = {"valid": "✅", "suspect": "⚠️", "invalid": "⛔"}
SENTENCES = {
    "": "",
    "valid": "The measurement is valid.",
    "suspect": "The measurement is suspect: its numbers may be wrong.",
    "invalid": "The measurement is invalid: do not use its numbers.",
}


def findings(report: Report) -> list[Finding]:
    """Return what was found, the worst first."""
    return sorted(report.findings, key=lambda found: -EFFECTS.index(found.effect))


def sentence(report: Report) -> str:
    """Return whether the measurement can be trusted, as a sentence; nothing when nobody judged it."""
    said = SENTENCES[report.validity]
    return said.replace("measurement", "comparison") if report.kind == "compare" else said


def reason(found: Finding) -> str:
    """Return the reason as a sentence."""
    return ended(plain(found.reason))


def remedy(found: Finding) -> str:
    """Return the remedy as a sentence; nothing when there is none."""
    text = plain(found.remedy).strip()
    return ended(f"Remedy: {text}") if text else ""


def ended(text: str) -> str:
    """Return text that ends with a full stop."""
    text = text.strip()
    return text if not text or text[-1] in ".!?" else f"{text}."
