"""How one episode ended."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """How one episode ended: after ``steps`` control steps."""

    task: str
    seed: int
    success: bool
    steps: int
