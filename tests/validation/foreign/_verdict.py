"""What a command's end means: works, refused with reason and remedy, wrong, or a fault of ours."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass

from _cells import ANSWERS, Cell

WORKS, REFUSED, BARE, WRONG, FAULT, MISSING = "works", "refused", "refused without remedy", "WRONG", "FAULT", "not run"
GOOD = (WORKS, REFUSED, MISSING)
REFUSING = (1, 2, 3, 4)
"""Exit codes of a refusal; 1 is that of a bundle which was written and found to be wrong."""
COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@dataclass(frozen=True)
class Verdict:
    """What is written into one cell of the table, and why.

    Args:
        kind: One of the constants of this module.
        why: The sentence that the command said, or what was measured.
    """

    kind: str
    why: str = ""


def judge(cell: Cell, code: int, out: str, err: str) -> Verdict:
    """Return what the end of a command means.

    Args:
        cell: The command.
        code: Its exit code; negative for a signal.
        out, err: What it printed.
    """
    if code in cell.codes:
        return _measured(cell, out) if cell.program == ANSWERS else Verdict(WORKS)
    said = _said(err)
    if code in REFUSING and said.startswith("error:"):
        return Verdict(REFUSED if "fix:" in said else BARE, said)
    return Verdict(FAULT, f"exit {code}: {said}")


def _measured(cell: Cell, out: str) -> Verdict:
    drift = float(json.loads(out.splitlines()[-1])["drift"])
    allowed = cell.drift if cell.drift is not None else 0.0
    return Verdict(WORKS if drift <= allowed else WRONG, f"differs by {drift:.2g} (allowed: {allowed:g})")


def _said(err: str) -> str:
    """The error and its remedy in one line; the last line where there is no error message."""
    lines = [COLOUR.sub("", line).strip() for line in err.splitlines() if line.strip()]
    starts = [index for index, line in enumerate(lines) if line.startswith("error:")]
    return " ".join(lines[starts[-1] :] if starts else lines[-2:]) or "it said nothing"


def markdown(columns: Sequence[tuple[str, str]], rows: Sequence[str], found: dict[tuple[str, str], Verdict]) -> str:
    """Return the table, then a note for each cell that is more than 'works'.

    Args:
        columns: Name and title of each policy.
        rows: Names of the rows.
        found: (name of the policy, row) -> verdict; what is absent does not apply.
    """
    notes: dict[str, int] = {}
    lines = ["| command | " + " | ".join(title for _, title in columns) + " |", "|---|" + "---|" * len(columns)]
    for row in rows:
        shown = [_shown(found.get((name, row)), notes) for name, _ in columns]
        lines.append(f"| `{row}` | " + " | ".join(shown) + " |")
    return "\n".join([*lines, "", *(f"{number}. {note}" for note, number in notes.items())]) + "\n"


def _shown(verdict: Verdict | None, notes: dict[str, int]) -> str:
    if verdict is None:
        return "-"
    if verdict.kind in (WORKS, MISSING):
        return verdict.kind
    return f"{verdict.kind} ({notes.setdefault(verdict.why, len(notes) + 1)})"
