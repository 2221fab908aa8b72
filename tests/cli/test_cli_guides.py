"""What a guide shows is run as it stands: its files are written, its commands run, its programs end well."""

from __future__ import annotations

import re
import runpy
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

GUIDES = Path(__file__).parents[2] / "docs/guides"
BLOCK = re.compile(r"(?:^`(?P<name>[^`\n]+)`\n\n)?^```(?P<kind>\w+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(guide: str) -> Iterator[tuple[str, str, str]]:
    """Name (empty when it has none), language and text of each block, in their order."""
    for found in BLOCK.finditer((GUIDES / guide).read_text(encoding="utf-8")):
        yield found["name"] or "", found["kind"], found["text"]


def follow(
    vlatool: Callable[..., tuple[int, str, str]], guide: str = "complete-policy.md", shown: Sequence[str] = ()
) -> Iterator[tuple[str, str]]:
    """Do in the current directory what the guide says; yield each command with what it printed.

    Blocks without a name are commands, or of a language in ``shown``: shown, and a part of a file.
    """
    for name, kind, text in blocks(guide):
        if name:
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_text(text)
            if kind == "python" and Path(name).parent == Path():
                runpy.run_path(name)
            continue
        if kind in shown:
            continue
        assert kind == "sh"
        for line in text.splitlines():
            program, *words = shlex.split(line)
            assert program == "vlatool"
            code, out, err = vlatool(*words)
            assert code == 0, f"{line}: {err}"
            yield line, out


def test_the_complete_policy_runs_as_the_guide_shows_it(tmp_path: Path, monkeypatch, vlatool):
    monkeypatch.chdir(tmp_path)
    printed = dict(follow(vlatool))
    assert len(printed) == 8
    (trained,) = [out for line, out in printed.items() if "distill" in line]
    assert re.search(r"in 20 steps on 256 observations", trained), trained
    (episodes,) = [out for line, out in printed.items() if "closed-loop" in line]
    assert re.search(r"100\.0% of 40 episodes succeed", episodes), episodes
    assert {path.name for path in Path("reach").iterdir()} >= {"statistics.json", "vocabulary.json", "environment.py"}


def test_the_environment_guide_runs_as_it_stands(tmp_path: Path, monkeypatch, vlatool):
    pytest.importorskip("gymnasium")
    monkeypatch.chdir(tmp_path)
    *_, (line, out) = follow(vlatool, "environment.md", shown=("yaml", "python", "text"))
    assert "closed-loop" in line
    assert re.search(r"100\.0% of 10 episodes succeed", out), out


def test_the_guide_to_verify_runs_as_it_stands(tmp_path: Path, monkeypatch, vlatool):
    monkeypatch.chdir(tmp_path)
    ((line, out),) = follow(vlatool, "verify.md", shown=["text"])
    assert line.startswith("vlatool verify")
    assert "reach gives what original.py:act gives" in out


def test_the_guide_to_the_runtime_runs_as_it_stands(tmp_path: Path, monkeypatch, vlatool):
    monkeypatch.chdir(tmp_path)
    (line, out), (run, shown), (record, _), (replay, verdict) = follow(vlatool, "runtime.md", shown=("yaml",))
    assert line == "vlatool export arm -o out/arm"
    assert "arm 1.0.0" in out
    assert run.startswith("vlatool run out/arm --dry-run")
    assert "FallbackLadder" in shown
    assert record.startswith("vlatool record")
    assert (replay, verdict) == ("vlatool replay out/arm.vlarun out/arm", "40 control steps: bit-equal\n")
