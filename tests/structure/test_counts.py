"""The counts of the structure and of words: what is planted is counted, and the counts stand in the page."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest
import words
from count import BEGIN, END, closure, entry_files, entry_points, replaced, table
from imports import ROOT


def kinds(code: str) -> list[tuple[str, str]]:
    return [(each.kind, each.word) for each in words.of_tree(ast.parse(code), "planted.py")]


@pytest.mark.parametrize(("word", "kind"), [
    ("told", "participle"), ("measured", "participle"), ("ahead", "adverb"), ("jointly", "adverb"),
    ("whatever", "pronoun"),
    ("need", ""), ("embed", ""), ("apply", ""), ("kept_files", ""), ("describe", ""), ("read", ""), ("recordings", ""),
])  # fmt: skip
def test_a_word_alone(word: str, kind: str):
    assert words.kind_of_word(word) == kind


@pytest.mark.parametrize(("code", "kind", "word"), [
    ("class A:\n    def held(self): ...", "functions named by a participle", "held"),
    ("def together(): ...", "functions named by an adverb or a pronoun", "together"),
    ("def _told(): ...", "functions named told", "_told"),
    ("LEAST = 3", "constants without a noun", "LEAST"),
    ("_AT_MOST: int = 3", "constants without a noun", "_AT_MOST"),
    ("def f(place): ...", "variables named place", "place"),
    ("for place in (): ...", "variables named place", "place"),
    ("raise ValueError(f'{x} is no number')", '"is no" in texts', "is no number"),
])  # fmt: skip
def test_what_is_planted_is_counted_with_a_suggestion(code: str, kind: str, word: str):
    assert (kind, word) in kinds(code)
    assert all(each.fix for each in words.of_tree(ast.parse(code), "planted.py"))


@pytest.mark.parametrize("code", [
    "def kept_files(): ...", "def _asked(): ...", "MAX_CALLS, _LIMITS = 64, 3", "def sorted(): ...", "LEAST_STEPS = 2",
    "text = 'there is no file; it is no longer here'", "print(place)", "def f():\n    MOST = 3",
])  # fmt: skip
def test_what_is_right_is_not_counted(code: str):
    assert kinds(code) == []


def test_a_module_named_by_a_participle_is_counted(tmp_path: Path):
    for name in ("__init__", "_made", "made_bundles", "structured"):
        (tmp_path / "vlatool").mkdir(exist_ok=True)
        (tmp_path / f"vlatool/{name}.py").write_text("")
    assert [(each.kind, each.word) for each in words.findings(tmp_path)] == [("modules named by a participle", "made")]
    assert words.exceeded(words.findings(tmp_path), {"modules named by a participle": 1}) == []
    over = words.exceeded(words.findings(tmp_path), {"modules named by a participle": 0})
    assert over[0].startswith("modules named by a participle: 1, at most 0 allowed")
    assert "vlatool/_made.py: made: a verb" in over[1]


def test_each_count_of_the_baseline_is_one_that_is_counted():
    assert set(json.loads(words.BASELINE.read_text())) == set(words.KINDS)


def test_an_entry_is_the_files_that_its_module_imports(tmp_path: Path):
    package = tmp_path / "tests/plugins/acme"
    package.mkdir(parents=True)
    (package / "one.py").write_text("import numpy\nfrom acme import _part\n")
    (package / "_part.py").write_text("from acme.other import x\n")
    (package / "other.py").write_text("x = 'AcmeExecutionProvider'\n")
    points = tmp_path / "tests/plugins/test_plugins.py"
    points.write_text('ENTRY_POINTS = """\n[vlatool.engines]\na = acme.one\nb = acme.other:X\nc = acme.gone\n"""\n')
    assert entry_points(points) == {"vlatool.engines": ["acme.one", "acme.other", "acme.gone"]}
    assert [path.name for path in closure(tmp_path / "tests/plugins", "acme.one")] == ["one.py", "_part.py", "other.py"]
    found = entry_files(tmp_path)
    assert (found["engine"], found["engine on another provider"], found["command"]) == (1, 1, 0)


def test_the_page_holds_the_counts():
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    assert f"{BEGIN}\n{table()}\n{END}" in page
    other = replaced(page, BEGIN, table().replace("0", "7"))
    assert other != page
    assert replaced(other, BEGIN, table()) == page
