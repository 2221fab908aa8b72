"""Draw the rooms of vlatool from the import contract in pyproject.toml, and list what each holds from its docstring.

Usage: python tests/structure/rooms.py [--check]

Writes docs/images/rooms.svg and the table in docs/architecture.md; ``--check`` fails when they differ from the code.
"""

from __future__ import annotations

import ast
import re
import sys
from html import escape
from pathlib import Path

from count import replaced
from imports import ROOT

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10, for which import-linter brings the same package
    import tomli as tomllib

PAGE, PICTURE = "docs/architecture.md", "docs/images/rooms.svg"
BEGIN = "<!-- written by tests/structure/rooms.py: make docs -->"
WIDTH, ROW, GAP = 980, 34, 8
"""Of the picture, in pixels: its width, the height of a row, and the space between two."""
SHADES = ("#dbe9f6", "#e8f3e4", "#fdf1d8")
"""Of rows: the commands, the stages and what they work with, what a robot and everything else needs."""


def layers(root: Path = ROOT) -> list[list[str]]:
    """Return the rows of rooms, the top one first, as the import contract has them."""
    contracts = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    rows = next(each["layers"] for each in contracts if each.get("containers") == ["vlatool"])
    return [re.split(r" *[|:] *", row) for row in rows]


def purpose(room: str, root: Path = ROOT) -> str:
    """Return the first paragraph of a room's docstring."""
    package = root / "vlatool" / room / "__init__.py"
    path = package if package.is_file() else root / "vlatool" / f"{room}.py"
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split()).replace("``", "`").replace("|", r"\|")


def table(root: Path = ROOT) -> str:
    """Return the picture and a row for each room, as Markdown."""
    rows = [f"| `{room}` | {purpose(room, root)} |" for row in layers(root) for room in row]
    return "\n".join(["![The rooms of vlatool](images/rooms.svg)", "", "| room | what it is for |", "|---|---|", *rows])


def picture(root: Path = ROOT) -> str:
    """Return the rows of rooms as SVG: imports point down, and rooms in one row do not import each other."""
    rows = layers(root)
    height = len(rows) * (ROW + GAP) + GAP
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" '
        f'font-size="13" text-anchor="middle">',
        "<title>The rooms of vlatool; imports point down</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="white"/>',
    ]
    for index, row in enumerate(rows):
        top, width = GAP + index * (ROW + GAP), (WIDTH - GAP) / len(row)
        shade = SHADES[3 * index // len(rows)]
        for number, room in enumerate(row):
            left = GAP + number * width
            parts.append(
                f'<rect x="{left:.1f}" y="{top}" width="{width - GAP:.1f}" height="{ROW}" rx="4" '
                f'fill="{shade}" stroke="#8797a5"/>'
                f'<text x="{left + (width - GAP) / 2:.1f}" y="{top + ROW / 2 + 5:.0f}">{escape(room)}</text>'
            )
    return "\n".join([*parts, "</svg>", ""])


def main() -> None:
    """Write the picture and the table, or compare them."""
    before = (ROOT / PAGE).read_text(encoding="utf-8")
    texts = {PAGE: replaced(before, BEGIN, table()), PICTURE: picture()}
    if "--check" not in sys.argv:
        for name, text in texts.items():
            (ROOT / name).write_text(text, encoding="utf-8")
        return
    stale = [name for name, text in texts.items() if not (ROOT / name).is_file() or (ROOT / name).read_text() != text]
    if stale or BEGIN not in before:
        sys.exit(f"{', '.join(stale or [PAGE])}: not what pyproject.toml and the docstrings say; run: make docs")
    print("the picture and the table of rooms equal the code")


if __name__ == "__main__":
    main()
