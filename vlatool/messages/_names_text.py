"""Names that others sent, as a sentence shows them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

MAX_NAMES, MAX_CHARACTERS = 40, 40


def names_text(names: Iterable[str]) -> str:
    """Return the first names, each cut where it is long, with commas between them; ``none`` without one."""
    return ", ".join(name[:MAX_CHARACTERS] for name in islice(names, MAX_NAMES)) or "none"
