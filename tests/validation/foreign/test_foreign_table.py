"""The table of foreign policies: what an end of a command means, and that the guides show the files that are run."""

from __future__ import annotations

import io
import json
import os
import re
from pathlib import Path

import pytest
from _cells import ANSWERS, QUANTIZED, Cell, cells, needs_data
from _foreign import BY_NAME, HERE, POLICIES
from _guide import GUIDES, GuideError, commands, files, follow
from _verdict import BARE, FAULT, REFUSED, WORKS, WRONG, Verdict, judge, markdown
from table import rows_of

from vlatool.module.description import read_description

PLAIN = Cell("quantize float16", ("quantize", "float16"))
MEASURED = Cell("infer float16", ("bundle", "policy", ""), ANSWERS, drift=0.02)
TOLD = "... exporting\nerror: The file x.npz has no 'ids'.\n  fix: record them\n"


@pytest.mark.parametrize(
    ("code", "err", "kind"),
    [
        (0, "", WORKS),
        (3, TOLD, REFUSED),
        (4, TOLD, REFUSED),
        (3, "error: The file x.npz has no 'ids'.\n", BARE),
        (3, "Traceback\nKeyError: 'zeros'", FAULT),
        (70, TOLD, FAULT),
        (1, TOLD, REFUSED),
        (1, "Traceback", FAULT),
        (-11, "", FAULT),
    ],
)
def test_the_end_of_a_command_is_told_apart(code, err, kind):
    assert judge(PLAIN, code, "", err).kind == kind


def test_a_reason_is_kept_with_its_remedy_and_without_colours():
    verdict = judge(PLAIN, 3, "", "\x1b[96m... step\x1b[0m\nerror: It is \x1b[1mwrong\x1b[0m.\n  fix: mend it\n")
    assert verdict.why == "error: It is wrong. fix: mend it"


def test_a_command_that_judges_may_say_no():
    judging = Cell("gate run", ("gate",), codes=(0, 1, 5))
    assert [judge(judging, code, "", "").kind for code in (0, 1, 5, 2)] == [WORKS, WORKS, WORKS, FAULT]


@pytest.mark.parametrize(("drift", "kind"), [(0.0, WORKS), (0.02, WORKS), (0.021, WRONG), (float("nan"), WRONG)])
def test_an_answer_that_differs_is_wrong_whatever_the_exit_code(drift, kind):
    assert judge(MEASURED, 0, json.dumps({"drift": drift, "rows": 16}), "").kind == kind


def test_the_table_has_a_note_for_each_reason():
    found = {
        ("a", "export"): Verdict(WORKS),
        ("a", "gate"): Verdict(REFUSED, "why"),
        ("b", "gate"): Verdict(WRONG, "why"),
    }
    lines = markdown([("a", "A"), ("b", "B")], ["export", "gate"], found).splitlines()
    assert lines[2:4] == ["| `export` | works | - |", "| `gate` | refused (1) | WRONG (1) |"]
    assert lines[-1] == "1. why"
    assert rows_of([POLICIES[0]], {(POLICIES[0].name, "export"): Verdict(WORKS)}) == ["export"]


@pytest.mark.parametrize("policy", POLICIES, ids=lambda policy: policy.name)
def test_each_policy_is_whole(policy):
    folder = HERE / policy.name
    assert read_description(folder).name
    assert set(policy.scripts) <= set(policy.files)
    assert policy.environment == (folder / "environment.py").is_file()
    listed = [cell.row for cell in cells(policy)]
    assert len(listed) == len(set(listed)) > 40
    named = sum("--calibration" in cell.words for cell in cells(policy))
    assert named == (sum(needs_data(words) for _, words, _ in QUANTIZED) if policy.source else 0)


@pytest.mark.parametrize("guide", GUIDES.values(), ids=GUIDES)
def test_a_guide_shows_the_files_that_are_run(guide):
    shown = {Path(name).name: text for name, text in files(guide.page).items() if name.startswith(f"{guide.folder}/")}
    there = {name: file.read_text() for name, file in BY_NAME[guide.policy].files.items() if name in shown}
    assert {name: shown[name] for name in there} == there
    assert "policy.yaml" in there
    assert set(guide.given) <= set(BY_NAME[guide.policy].files)
    assert set(shown) - set(there) <= {"robot.py"}


PINS = re.compile(r"^([a-z-]+)(?:\[\w+\])?==([\w.]+)", re.MULTILINE)


@pytest.mark.parametrize(("packages", "guide"), [("lerobot", "lerobot"), ("common", "hugging-face")])
def test_a_guide_installs_what_is_run(packages, guide):
    pins = dict(PINS.findall((HERE / f"{packages}.txt").read_text()))
    (line,) = re.findall(r"^pip install .*", GUIDES[guide].page.read_text(), re.MULTILINE)
    told = dict(word.split("==") for word in line.split() if "==" in word)
    assert told
    assert told == {name: pins[name] for name in told}
    least = re.search(r"torch>=2\.(\d+)", (HERE.parents[2] / "pyproject.toml").read_text())
    assert least
    assert int(least[1]) <= int(pins["torch"].split(".")[1])


def test_a_lerobot_checkpoint_becomes_a_report_in_five_commands_at_most():
    said = commands(GUIDES["lerobot"].page)
    assert next(index for index, line in enumerate(said) if line.startswith("vlatool optimize")) < 5


def page(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "page.md"
    file.write_text(text)
    return file


def test_a_guide_is_followed_in_its_order(tmp_path):
    text = (
        "`a/b.txt`\n\n```text\none\n```\n\n```sh\ncp a/b.txt c.txt\n```\n\n"
        "```text\nexit 1\n```\n\n```sh\ncat c.txt\n```\n"
    )
    said = io.StringIO()
    assert follow(page(tmp_path, text), tmp_path, os.environ, said) == 2
    assert (tmp_path / "c.txt").read_text() == "one\n"
    assert said.getvalue() == "$ cp a/b.txt c.txt\n$ cat c.txt\n"


def test_a_guide_whose_command_fails_is_told(tmp_path):
    with pytest.raises(GuideError, match=r"cat missing.txt\n +ended with 1: .*No such file"):
        follow(page(tmp_path, "```sh\ncat missing.txt\n```\n"), tmp_path, {**os.environ, "LC_ALL": "C"}, io.StringIO())
