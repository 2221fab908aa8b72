"""Bundles that were made to show what something is worth, not to be used."""

from __future__ import annotations

from vlatool.bundle.bundle import Bundle
from vlatool.stage.finish import history

OPTION = "control"
"""Option of a stage that says so, whatever it is but ``none``, its default."""


def controls(bundle: Bundle) -> tuple[str, ...]:
    """Return a sentence for each stage of a bundle's build record that was a control; none for a bundle to be used."""
    named = ((entry["stage"], entry.get("options", {}).get(OPTION)) for entry in history(bundle))
    return tuple(
        f"a control, not for a robot: {stage} was run with --{OPTION} {value}" for stage, value in named if value
    )
