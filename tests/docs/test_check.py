"""The check of the pages: each kind of fault, planted in a page, is seen; what is right is taken."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def check() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_check", ROOT / "docs/check.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def page(check):
    """A page of the docs with this text."""
    return lambda text: check.Page(ROOT / "docs/page.md", text)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[gone](guides/gone.md)", "the link guides/gone.md leads nowhere"),
        ("[there](guides/gate.md#no-such-heading)", "names a heading that the page does not have"),
    ],
)
def test_a_link_must_lead_somewhere(check, page, text, fault):
    assert any(fault in found for found in check.links(page(text)))


def test_links_to_pages_headings_and_the_web_are_taken(check, page):
    text = "# Here it is\n[a](guides/gate.md) [b](guides/gate.md#in-ci) [c](#here-it-is) [d](https://example.org/x.md)"
    assert not list(check.links(page(text)))


@pytest.mark.parametrize(
    "code",
    ["vlatool/hwselect/model.py", "runtime/no_such.py", "tests/soak/gone.py", "vlatool.no_such.module", "_pixels"],
)
def test_a_path_that_does_not_exist_is_a_fault(check, page, code):
    assert list(check.paths(page(f"See `{code}`.")))


@pytest.mark.parametrize(
    "code",
    ["vlatool/errors.py", "runtime/engine.py", "tests/plugins/", "vlatool.registry", "vlatool.runtime.ChunkQueue",
     "_journal", "reports/report.json"],
)  # fmt: skip
def test_a_path_that_exists_is_none(check, page, code):
    assert not list(check.paths(page(f"See `{code}`.")))


def test_a_file_that_the_page_shows_is_no_fault(check, page):
    assert not list(check.paths(page("`tests/mine.py`\n\n```python\n```\n\nSee `tests/mine.py`.")))


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        ("vlatool optimise policy", "vlatool has no command optimise"),
        ("vlatool export policy --no-such", "has no option --no-such"),
        ("vlatool export policy \\\n  --no-such", "has no option --no-such"),
        ("FAST=1 vlatool quantize policy --no-such", "has no option --no-such"),
        ("cd out && make teapot", "make has no target teapot"),
    ],
)
def test_a_command_must_exist(check, page, command, fault):
    assert any(fault in found for found in check.commands(page(f"```\n{command}\n```\n")))


def test_commands_that_exist_are_taken(check, page):
    text = "```\nvlatool quantize policy --profile pi5 -o out  # why\nmake demo\n```\nand `vlatool cache prune --all`"
    assert not list(check.commands(page(text)))


@pytest.mark.parametrize(
    "text",
    ["```text\nerror: The bundle is tired and wants to sleep.\n```\n",
     "| what it says | do |\n|---|---|\n| `it wants to sleep` | wait |\n"],
)  # fmt: skip
def test_a_quote_must_be_a_message_of_the_source(check, page, text):
    assert list(check.messages(page(text)))


@pytest.mark.parametrize(
    "quote",
    ["… exists already.", "This needs the package 'torch', which the extra 'build' provides.", "out of memory."],
)
def test_quotes_may_leave_out_values_or_put_them_in(check, page, quote):
    assert not list(check.messages(page(f"```text\nerror: {quote}\n```\n")))


def test_translated_phrases_are_faults(check, page):
    assert list(check.words(page("Commands leave with 0, and how to mend it.")))
    assert not list(check.words(page("Commands exit with 0, and how to fix it.")))


def test_a_page_that_the_code_names_must_exist(check, tmp_path):
    (tmp_path / "vlatool").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "Makefile").write_text("")
    (tmp_path / "vlatool/errors.py").write_text('FIX = "see docs/guides/gone.md"\n')
    assert check.pages_named_by_code(tmp_path) == ["vlatool/errors.py: there is no page docs/guides/gone.md"]


def test_troubleshooting_quotes_messages(check):
    text = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    assert len(check.MESSAGE.findall(text)) > 25
    assert len(list(check.quotes_in_tables(text))) > 8


def test_the_measurements_keep_their_commands():
    """A table of figures stands below the command that printed it."""
    for path in (ROOT / "docs/measurements").glob("*.md"):
        assert "```\n" in path.read_text(encoding="utf-8"), path.name
