"""Follow a guide as a newcomer does: write the files that it shows, run the commands that it says."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

DOCS = Path(__file__).parents[3] / "docs/guides"
BLOCK = re.compile(r"(?:^`(?P<name>[^`\n]+)`\n\n)?^```(?P<kind>\w+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)


class GuideError(Exception):
    """A command of a guide did not run as it stands there."""


@dataclass(frozen=True)
class Guide:
    """A page, and what its reader has before the first command.

    Args:
        page: The Markdown file.
        policy: The folder below tests/validation/foreign whose files it shows.
        folder: How the page calls that folder.
        packages: Which environment it needs.
        given: What the reader has; the first is the program that makes checkpoint and recordings.
    """

    page: Path
    policy: str
    folder: str
    packages: str
    given: tuple[str, ...] = ("original.py",)


GUIDES = {
    "lerobot": Guide(DOCS / "lerobot-policy.md", "lerobot_act", "act", "lerobot", ("original.py", "made.py")),
    "hugging-face": Guide(DOCS / "hugging-face-policy.md", "llama", "llama", "common"),
    "recurrent": Guide(
        DOCS / "recurrent-policy.md", "resnet_gru", "recurrent", "common", ("original.py", "network.py")
    ),
    "onnx-file": Guide(DOCS / "onnx-file.md", "clip", "clip", "common"),
}


def blocks(page: Path) -> Iterator[tuple[str, str, str]]:
    """Name (empty when it has none), language and text of each block of a page, in their order."""
    for found in BLOCK.finditer(page.read_text(encoding="utf-8")):
        yield found["name"] or "", found["kind"], found["text"]


def commands(page: Path) -> list[str]:
    """The commands of a page, one a line."""
    shown = [text for name, kind, text in blocks(page) if kind == "sh" and not name]
    return [line for text in shown for line in text.splitlines() if line and not line.startswith("#")]


def files(page: Path) -> dict[str, str]:
    """Name -> contents of the files that a page shows."""
    return {name: text for name, _, text in blocks(page) if name}


def follow(page: Path, folder: Path, variables: Mapping[str, str], said: TextIO) -> int:
    """Write the page's files into a folder and run its commands there, in the order of the page; return their number.

    Raises:
        GuideError: when a command does not end with 0.
    """
    count = 0
    for name, kind, text in blocks(page):
        if name:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
        elif kind == "sh":
            for line in filter(None, text.splitlines()):
                print(f"$ {line}", file=said, flush=True)
                _do(line, folder, variables)
                count += 1
    return count


def _do(line: str, folder: Path, variables: Mapping[str, str]) -> None:
    done = subprocess.run(["bash", "-c", line], cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        raise GuideError(f"{line}\n  ended with {done.returncode}: {done.stderr.strip()[-2000:]}")
