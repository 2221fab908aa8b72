"""Only modules of ``vlatool/measures`` spell the names of quantities, of raw samples and of tables of details."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest
from imports import modules

from vlatool.measures import Pattern, families, quantities, series, tables

VOCABULARY = "vlatool.measures"
OTHER_MEANINGS = {"latency_in_the_loop", "latency_ms", "golden_error", "cpu"}
"""Names that an option, a limit, a finding and a device have as well."""


def names_of(module: object) -> tuple[set[str], list[Pattern]]:
    """The constants of a module of the vocabulary: names, and names with a part."""
    values = [value for key, value in vars(module).items() if key.isupper()]
    flat = [each for value in values for each in (value if isinstance(value, tuple) else (value,))]
    return {each for each in flat if isinstance(each, str)}, [each for each in flat if isinstance(each, Pattern)]


NAMES = set(quantities()) - OTHER_MEANINGS
PATTERNS = [family.pattern for family in families()] + [each for one in (series, tables) for each in names_of(one)[1]]
ENDS = {end for pattern in PATTERNS for end in pattern.text.replace("}", "{").split("{")[::2] if len(end) > 1}
WORDS = NAMES | names_of(series)[0] | names_of(tables)[0]
PLAIN = {name for name in WORDS - OTHER_MEANINGS if any(sign in name for sign in "_. ")} | ENDS - {"latency_", "error."}
"""What means nothing else, wherever it stands; a word such as 'memory' counts where a measurement is named."""


def spelled(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each literal that names what the vocabulary has."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and node.value in PLAIN:
            yield node.lineno, str(node.value)
        elif isinstance(node, ast.Call):
            yield from _called(node)
        elif isinstance(node, ast.Compare) and isinstance(node.left, ast.Attribute) and node.left.attr == "name":
            sides = [item for side in node.comparators for item in getattr(side, "elts", [side])]
            yield from ((node.lineno, side.value) for side in sides if getattr(side, "value", "") in NAMES)
        elif isinstance(node, ast.Subscript) and _is_of_row(node.value) and _is_text(node.slice):
            yield node.lineno, ast.unparse(node.slice)


def _called(node: ast.Call) -> Iterator[tuple[int, str]]:
    function = getattr(node.func, "attr", getattr(node.func, "id", ""))
    first = node.args[0] if node.args else None
    renamed = [each.value for each in node.keywords if each.arg == "name" and function == "replace"]
    if function == "Measurement" and _is_text(first) and ast.unparse(first) != "''":
        yield node.lineno, ast.unparse(first)
    yield from ((node.lineno, each.value) for each in renamed if getattr(each, "value", "") in NAMES)
    known = getattr(first, "value", "") in WORDS
    if (function == "value" and known) or (
        function == "get" and _is_text(first) and _is_of_row(getattr(node.func, "value", None))
    ):
        yield node.lineno, ast.unparse(first)


def _is_text(node: ast.AST | None) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _is_of_row(node: ast.AST | None) -> bool:
    """Whether it is the raw samples or the details of a row."""
    return isinstance(node, ast.Attribute) and node.attr in ("raw", "details")


def test_the_vocabulary_alone_spells_its_names():
    found = [
        f"{path.name}:{line}: {text}"
        for name, path in modules().items()
        if not name.startswith(VOCABULARY)
        for line, text in spelled(path.read_text())
    ]
    assert found == []


@pytest.mark.parametrize("planted", [
    'row.get("latency_p50")', 'row.value("success")', 'Measurement("size", 1.0, "MB")',
    'SHOWN = {"peak_rss": "memory"}',
    'Measurement(f"error_{whose}", 1.0, "1")', 'f"error_baseline.{label}"', 'item.name.endswith("_ratio")',
    'name.startswith("training_time.")', 'item.name == "memory"', 'item.name in ("speedup", "size")',
    'replace(item, name="memory")', 'row.raw["success"]', 'row.details.get("engine", ())', 'f"motion.{metric}"',
    'TABLE = "time by phase"',
])  # fmt: skip
def test_a_spelled_name_is_seen(planted: str):
    assert list(spelled(planted)) != []


@pytest.mark.parametrize("other", [
    "row.get(LATENCY_P50)", 'host.get("memory")', 'record["success"]', 'environment["cpu"]', 'size = "size"',
    "MEMORY.measurement(1.0)", 'Measurement("", math.nan, "1")', "row.raw[series.SUCCESS]", 'report.kind == "speedup"',
])  # fmt: skip
def test_other_words_are_not(other: str):
    assert list(spelled(other)) == []
