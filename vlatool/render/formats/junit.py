"""The report as JUnit XML, which Jenkins, GitLab and GitHub actions show as test results."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from vlatool.measures.tables import CLAIMS
from vlatool.render._trust import reasons, sentence
from vlatool.report import Report

CONTROLS = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""What XML 1.0 does not allow."""
FAULTS = {"fail": "failure", "invalid": "error"}
SKIPPED_VERDICTS = ("inconclusive", "suspect")


class JunitRenderer:
    """Writes a test suite: one case for each claim of a gate, or one for the whole report.

    A measurement that was judged is one more case, ``measurement``: an error when it is invalid, skipped when suspect.
    """

    def render(self, report: Report) -> str:
        """Return the XML text."""
        cases = [*cases_of(report), *_trust(report)]
        counts = {
            "tests": len(cases),
            "failures": sum(verdict == "fail" for _, verdict, _ in cases),
            "errors": sum(verdict == "invalid" for _, verdict, _ in cases),
            "skipped": sum(verdict in SKIPPED_VERDICTS for _, verdict, _ in cases),
        }
        shared = {name: str(count) for name, count in counts.items()}
        root = ElementTree.Element("testsuites", {"name": "vlatool", **shared})
        suite = ElementTree.SubElement(root, "testsuite", {"name": clean(report.title), **shared})
        if report.created:
            suite.set("timestamp", report.created.removesuffix("+00:00"))
        for name, verdict, text in cases:
            case = ElementTree.SubElement(suite, "testcase", {"name": name, "classname": f"vlatool.{report.kind}"})
            if verdict in FAULTS:
                ElementTree.SubElement(case, FAULTS[verdict], {"message": clean(text)}).text = clean(report.command)
            elif verdict in SKIPPED_VERDICTS:
                ElementTree.SubElement(case, "skipped", {"message": clean(f"{verdict}: {text}")})
            ElementTree.SubElement(case, "system-out").text = clean(text)
        ElementTree.indent(root)
        return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def cases_of(report: Report) -> list[tuple[str, str, str]]:
    """Return (name, verdict, what was found) of each claim, or of the whole report when it has none."""
    return claims(report) or [("verdict", report.verdict, " ".join(report.summary) or report.title)]


def _trust(report: Report) -> list[tuple[str, str, str]]:
    """Return a case that says whether the measurement can be trusted; nothing when nobody judged it."""
    if not report.validity:
        return []
    why = [part for _, reason, remedy in reasons(report) for part in (reason, remedy) if part]
    return [("measurement", report.validity, " ".join([sentence(report), *why]))]


def claims(report: Report) -> list[tuple[str, str, str]]:
    """Return (claim, verdict, what was found) of a gate's report; nothing for another one."""
    return [
        (str(record.get("claim", "")), str(record.get("verdict", "")), str(record.get("found", "")))
        for row in report.rows
        for record in row.details.get(CLAIMS, ())
    ]


def clean(text: str) -> str:
    """Return text without the characters that XML does not allow."""
    return CONTROLS.sub("?", text)
