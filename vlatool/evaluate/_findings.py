"""What an evaluation says of a bundle that ``load`` refuses."""

from __future__ import annotations

from vlatool.bundle.bundle import Bundle


def found_wrong(bundle: Bundle) -> tuple[str, ...]:
    """Return what a stage found to be wrong with a bundle, in sentences."""
    return tuple(
        f"load refuses this bundle ({finding['name']}): {finding['message']}" for finding in bundle.manifest.findings
    )
