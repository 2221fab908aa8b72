"""The report as JUnit XML, which Jenkins, GitLab and GitHub actions show as test results."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from vlatool.report import Report

CONTROLS = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""What XML 1.0 does not allow."""


class JunitRenderer:
    """Writes a test suite: one case for each claim of a gate, or one for the whole report."""

    def render(self, report: Report) -> str:
        """Return the XML text."""
        cases = claims(report) or [("verdict", report.verdict, " ".join(report.summary) or report.title)]
        counts = {
            "tests": len(cases),
            "failures": sum(verdict == "fail" for _, verdict, _ in cases),
            "errors": 0,
            "skipped": sum(verdict == "inconclusive" for _, verdict, _ in cases),
        }
        shared = {name: str(count) for name, count in counts.items()}
        root = ElementTree.Element("testsuites", {"name": "vlatool", **shared})
        suite = ElementTree.SubElement(root, "testsuite", {"name": clean(report.title), **shared})
        if report.created:
            suite.set("timestamp", report.created.removesuffix("+00:00"))
        for name, verdict, said in cases:
            case = ElementTree.SubElement(suite, "testcase", {"name": name, "classname": f"vlatool.{report.kind}"})
            if verdict == "fail":
                ElementTree.SubElement(case, "failure", {"message": clean(said)}).text = clean(report.command)
            elif verdict == "inconclusive":
                ElementTree.SubElement(case, "skipped", {"message": clean(f"inconclusive: {said}")})
            ElementTree.SubElement(case, "system-out").text = clean(said)
        ElementTree.indent(root)
        return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def claims(report: Report) -> list[tuple[str, str, str]]:
    """Return (claim, verdict, what was found) of a gate's report; nothing for another one."""
    return [
        (str(record.get("claim", "")), str(record.get("verdict", "")), str(record.get("found", "")))
        for row in report.rows
        for record in row.details.get("claims", ())
    ]


def clean(text: str) -> str:
    """Return text without the characters that XML does not allow."""
    return CONTROLS.sub("?", text)
