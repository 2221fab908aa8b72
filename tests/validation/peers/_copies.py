"""Bundles of ours with equal graphs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from _interleave import Contestant
from _ours import COMMANDS, MARK, OPTIMIZE, bundle_of
from _workload import Workload


def without_copies(
    workload: Workload, contestants: Sequence[Contestant], tell: Callable[[str], None] = print
) -> list[Contestant]:
    """Leave out what an option did not change: the fastest of several copies would be the luckiest."""
    first: dict[str, str] = {}
    kept = []
    for contestant in contestants:
        own = contestant.name.removeprefix(MARK)
        single = contestant.ours and not contestant.failed and own in COMMANDS and COMMANDS[own][:1] != (OPTIMIZE,)
        same = first.setdefault(graphs_digest(bundle_of(workload, own)), contestant.name) if single else contestant.name
        if same == contestant.name:
            kept.append(contestant)
        else:
            tell(f"  {contestant.name}: left out, since its graphs are those of {same}")
    return kept


def graphs_digest(bundle: Path) -> str:
    """Return the SHA-256 of the graphs of a bundle."""
    graphs = sorted((bundle / "graphs").rglob("*"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in graphs if path.is_file())).hexdigest()
