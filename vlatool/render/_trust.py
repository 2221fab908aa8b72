"""Whether a measurement can be trusted, and why: the same words in every format."""

from __future__ import annotations

from vlatool.render._format import plain
from vlatool.report import EFFECTS, Finding, Report

SENTENCES = {
    "": "",
    "valid": "The measurement is valid.",
    "suspect": "The measurement is suspect: its numbers may be wrong.",
    "invalid": "The measurement is invalid: do not use its numbers.",
}


def findings(report: Report) -> list[Finding]:
    """Return what was found, the worst first."""
    return sorted(report.findings, key=lambda finding: -EFFECTS.index(finding.effect))


def sentence(report: Report) -> str:
    """Return whether the measurement can be trusted, as a sentence; nothing when nobody judged it."""
    judgement = SENTENCES[report.validity]
    return judgement.replace("measurement", "comparison") if report.kind == "compare" else judgement


def reason(finding: Finding) -> str:
    """Return the reason as a sentence."""
    return ended(plain(finding.reason))


def remedy(finding: Finding) -> str:
    """Return the remedy as a sentence; nothing when there is none."""
    text = plain(finding.remedy).strip()
    return ended(f"Remedy: {text}") if text else ""


def ended(text: str) -> str:
    """Return text that ends with a full stop."""
    text = text.strip()
    return text if not text or text[-1] in ".!?" else f"{text}."
