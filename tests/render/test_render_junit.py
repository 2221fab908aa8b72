from __future__ import annotations

from xml.etree import ElementTree

import pytest
from _render_reports import HOSTILE

from vlatool.render import render
from vlatool.report import Finding, Report, Row


def gate(*claims: tuple[str, str, str], verdict: str = "fail") -> Report:
    table = [{"claim": name, "verdict": said, "found": found} for name, said, found in claims]
    rows = (Row("candidate", details={"claims": table}),)
    made = {"command": "vlatool gate x", "created": "2026-11-22T01:02:03+00:00"}
    return Report("gate", "Gate of x", verdict, ("x does not keep to it.",), rows, **made)


def test_each_claim_is_a_case() -> None:
    report = gate(("size", "pass", "1 MB"), ("latency", "fail", "9 % slower"), ("deadline", "inconclusive", "few"))
    root = ElementTree.fromstring(render(report, "junit"))
    assert root.attrib == {"name": "vlatool", "tests": "3", "failures": "1", "errors": "0", "skipped": "1"}
    (suite,) = root
    assert suite.get("timestamp") == "2026-11-22T01:02:03"
    cases = {case.get("name"): case for case in suite}
    assert cases["size"].find("failure") is None
    assert cases["size"].findtext("system-out") == "1 MB"
    assert cases["latency"].find("failure").get("message") == "9 % slower"
    assert cases["latency"].findtext("failure") == "vlatool gate x"
    assert cases["deadline"].find("skipped").get("message") == "inconclusive: few"


def test_a_report_without_claims_is_one_case() -> None:
    root = ElementTree.fromstring(render(Report("optimize", "T", "fail", ("Nothing fits.",)), "junit"))
    (case,) = root[0]
    assert (case.get("name"), case.get("classname")) == ("verdict", "vlatool.optimize")
    assert case.find("failure").get("message") == "Nothing fits."


def test_hostile_text_stays_text() -> None:
    text = HOSTILE + "\x00\x0b\ud800"
    root = ElementTree.fromstring(render(gate(("latency", "fail", text)), "junit").encode("utf-8"))
    message = root[0][0].find("failure").get("message")
    assert "<script>alert('x')</script>" in message
    assert "\x1b" not in message


@pytest.mark.parametrize(
    ("verdict", "line"),
    [
        ("fail", "::error title=Gate of x%3A latency fail::9 %25 slower%0Anow"),
        ("inconclusive", "::warning title=Gate of x%3A latency inconclusive::9 %25 slower%0Anow"),
        ("pass", "::notice title=Gate of x::x does not keep to it."),
    ],
)
def test_github_is_told_what_is_wrong(verdict: str, line: str) -> None:
    assert render(gate(("latency", verdict, "9 % slower\nnow")), "github") == line + "\n"


def test_github_is_told_of_every_report() -> None:
    assert (
        render(Report("optimize", "a, b", "fail", ("No.",)), "github") == "::error title=a%2C b%3A verdict fail::No.\n"
    )


WRONG = (Finding("note", "It is warm."), Finding("suspect", "It throttled", "cool it"), Finding("invalid", "It lied."))


@pytest.mark.parametrize(
    ("validity", "tag", "errors", "skipped"),
    [("invalid", "error", "1", "0"), ("suspect", "skipped", "0", "1"), ("valid", None, "0", "0")],
)
def test_a_judged_measurement_is_a_case(validity: str, tag: str | None, errors: str, skipped: str) -> None:
    report = Report("benchmark", "T", command="vlatool x", validity=validity, findings=WRONG)
    root = ElementTree.fromstring(render(report, "junit"))
    assert (root.get("tests"), root.get("errors"), root.get("skipped")) == ("2", errors, skipped)
    (case,) = (case for case in root[0] if case.get("name") == "measurement")
    assert [child.tag for child in case] == [*([tag] if tag else []), "system-out"]
    assert "It lied. It throttled. Remedy: cool it. It is warm." in case.findtext("system-out")


def test_github_is_told_each_reason_and_remedy() -> None:
    report = Report("benchmark", "T", validity="invalid", findings=WRONG)
    assert render(report, "github").splitlines() == [
        "::error title=T%3A measurement invalid::It lied.",
        "::warning title=T%3A measurement suspect::It throttled. Remedy: cool it.",
    ]
    bare = Report("benchmark", "T", validity="suspect")
    assert render(bare, "github").startswith("::warning title=T%3A measurement suspect::The measurement is suspect")
    assert render(Report("benchmark", "T", validity="valid"), "github") == "::notice title=T::T\n"
