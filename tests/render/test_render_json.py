from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from _render_reports import KINDS, sustained
from jsonschema import Draft202012Validator

from vlatool.render import render
from vlatool.report import Report

DOCS = Path(__file__).parents[2] / "docs"
SCHEMA = json.loads((DOCS / "reference/report.schema.json").read_text())
VALIDATOR = Draft202012Validator(SCHEMA)


def test_the_schema_is_a_schema() -> None:
    Draft202012Validator.check_schema(SCHEMA)


def test_the_schema_is_that_of_the_code() -> None:
    found = importlib.util.spec_from_file_location("docs_generate", DOCS / "generate.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    assert (DOCS / "reference/report.schema.json").read_text() == module.schema_page()


@pytest.mark.parametrize("kind", KINDS)
def test_every_report_keeps_to_the_schema(kind: str) -> None:
    VALIDATOR.validate(json.loads(render(KINDS[kind](), "json")))


def put(*path: str | int) -> Callable[[dict[str, Any], Any], None]:
    """Return a function that writes a value at that place of a report."""

    def write(data: Any, value: Any) -> None:
        for step in path[:-1]:
            data = data[step]
        data[path[-1]] = value

    return write


MEASUREMENT = ("rows", 0, "measurements", 0)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("schema",), 2),
        (("kind",), None),
        (("verdict",), "great"),
        (("validity",), "fine"),
        (("findings", 0, "effect"), "bad"),
        (("findings", 0, "severity"), 1),
        (("rows",), {}),
        (("rows", 0, "role"), "winner"),
        (("rows", 0, "colour"), "red"),
        (("rows", 0, "raw", "latency_ms"), ["1.0"]),
        (("rows", 0, "details", "engine"), ["ort_cpu"]),
        ((*MEASUREMENT, "value"), "fast"),
        ((*MEASUREMENT, "origin"), "guessed"),
        ((*MEASUREMENT, "confidence"), 95),
        ((*MEASUREMENT, "samples"), 1.5),
        ((*MEASUREMENT, "p"), 0.5),
        (("warnings",), "one"),
    ],
)
def test_a_broken_report_does_not(path: tuple[str | int, ...], value: Any) -> None:
    data = json.loads(sustained().to_json())
    assert VALIDATOR.is_valid(data)
    put(*path)(data, value)
    assert not VALIDATOR.is_valid(data)


@pytest.mark.parametrize("key", ["schema", "kind", "title"])
def test_what_a_report_cannot_do_without(key: str) -> None:
    data = json.loads(Report("benchmark", "t").to_json())
    del data[key]
    assert not VALIDATOR.is_valid(data)


def test_a_number_that_could_not_be_had_is_null() -> None:
    text = render(sustained(), "json")
    assert "NaN" not in text
    missing = [item for item in json.loads(text)["rows"][0]["measurements"] if item["value"] is None]
    assert {item["name"] for item in missing} == {"latency_p99.9", "energy_per_action", "power_mean"}
    assert all(item["note"] for item in missing)
