"""What an evaluation calls its variants."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.bundle.bundle import Bundle

BASELINE = "baseline"


def names_of(bundles: Sequence[Bundle]) -> list[str]:
    """Return the names of variants: ``baseline``, where there is one, and that of the policy.

    Two bundles of one policy have its name alike, which says nothing of either: they are told apart by their folders,
    as much of their paths as it takes.

    Args:
        bundles: The variant last, after its baseline.
    """
    *_, own = [bundle.manifest.name for bundle in bundles]
    if len(bundles) < 2:
        return [own]
    parts = [bundle.path.resolve().parts for bundle in bundles]
    if bundles[0].manifest.name != own or parts[0] == parts[1]:
        return [BASELINE, own]
    depth = next((depth for depth in range(1, len(parts[0]) + 1) if parts[0][-depth:] != parts[1][-depth:]), 1)
    return ["/".join(part[-depth:]) for part in parts]
