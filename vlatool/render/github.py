"""The report as workflow commands of GitHub Actions: one annotation for each claim that is not kept."""

from __future__ import annotations

from vlatool.render.junit import claims
from vlatool.report import Report

COMMANDS = {"fail": "error", "inconclusive": "warning"}


class GithubRenderer:
    """Writes ``::error title=...::...`` lines, which GitHub shows on the pull request when a job prints them."""

    def render(self, report: Report) -> str:
        """Return the lines; a notice when nothing is wrong."""
        cases = claims(report) or [("verdict", report.verdict, " ".join(report.summary) or report.title)]
        lines = [
            f"::{COMMANDS[verdict]} title={field(f'{report.title}: {name} {verdict}')}::{data(said)}"
            for name, verdict, said in cases
            if verdict in COMMANDS
        ]
        first = report.summary[0] if report.summary else report.title
        return "\n".join(lines or [f"::notice title={field(report.title)}::{data(first)}"]) + "\n"


def data(text: str) -> str:
    """Return text as the message of a workflow command (actions/toolkit, core/command.ts, escapeData)."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def field(text: str) -> str:
    """Return text as a property of a workflow command (escapeProperty)."""
    return data(text).replace(":", "%3A").replace(",", "%2C")
