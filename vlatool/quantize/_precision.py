"""Share of a graph's multiply-accumulates by the precision that they are computed in."""

from __future__ import annotations

from pathlib import Path


def precision_shares(path: Path) -> dict[str, float]:
    """Return precision -> share of the multiply-accumulates (rounded to 0.001, the largest first)."""
    from vlatool.hwselect._workload import graph_workload

    macs = graph_workload(path).macs
    total = sum(macs.values()) or 1
    shares = {name: round(count / total, 3) for name, count in macs.items() if count}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
