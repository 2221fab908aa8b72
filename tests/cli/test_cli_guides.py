"""What a guide shows is run as it stands: its files are written, its commands run, its programs end well."""

from __future__ import annotations

import re
import runpy
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

GUIDE = Path(__file__).parents[2] / "docs/guides/complete-policy.md"
BLOCK = re.compile(r"(?:^`(?P<name>[^`\n]+)`\n\n)?^```(?P<kind>\w+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks() -> Iterator[tuple[str, str, str]]:
    """Name (empty when it has none), language and text of each block, in their order."""
    for found in BLOCK.finditer(GUIDE.read_text(encoding="utf-8")):
        yield found["name"] or "", found["kind"], found["text"]


def follow(vlatool: Callable[..., tuple[int, str, str]]) -> Iterator[tuple[str, str]]:
    """Do in the current directory what the guide says; yield each command with what it printed."""
    for name, kind, text in blocks():
        if name:
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_text(text)
            if kind == "python" and Path(name).parent == Path():
                runpy.run_path(name)
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
    assert len(printed) == 6
    (episodes,) = [out for line, out in printed.items() if "closed-loop" in line]
    assert re.search(r"100\.0% of 40 episodes succeed", episodes), episodes
    assert {path.name for path in Path("reach").iterdir()} >= {"statistics.json", "vocabulary.json", "environment.py"}
