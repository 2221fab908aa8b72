"""The report as workflow commands of GitHub Actions: one annotation for each claim that is not kept.

Each reason not to trust the measurement is one more: a warning where it is suspect, an error where it is invalid.
"""

from __future__ import annotations

from vlatool.render._trust import reasons, sentence
from vlatool.render.formats.junit import cases_of
from vlatool.report import Report

COMMANDS = {"fail": "error", "inconclusive": "warning", "invalid": "error", "suspect": "warning"}


class GithubRenderer:
    """Writes ``::error title=...::...`` lines, which GitHub shows on the pull request when a job prints them."""

    def render(self, report: Report) -> str:
        """Return the lines; a notice when nothing is wrong."""
        cases = [*cases_of(report), *_trust(report)]
        lines = [
            f"::{COMMANDS[verdict]} title={field(f'{report.title}: {name} {verdict}')}::{data(text)}"
            for name, verdict, text in cases
            if verdict in COMMANDS
        ]
        first = report.summary[0] if report.summary else report.title
        return "\n".join(lines or [f"::notice title={field(report.title)}::{data(first)}"]) + "\n"


def _trust(report: Report) -> list[tuple[str, str, str]]:
    """Return (name, effect, text) of each finding; of the judgement alone when no finding says why."""
    findings = [("measurement", effect, f"{reason} {remedy}".strip()) for effect, reason, remedy in reasons(report)]
    if any(effect == report.validity for _, effect, _ in findings):
        return findings
    return [("measurement", report.validity, sentence(report)), *findings]


def data(text: str) -> str:
    """Return text as the message of a workflow command (actions/toolkit, core/command.ts, escapeData)."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def field(text: str) -> str:
    """Return text as a property of a workflow command (escapeProperty)."""
    return data(text).replace(":", "%3A").replace(",", "%2C")
