"""What a reader of a bundle's numbers should know of how it was made: as a control, or by predictions."""

from __future__ import annotations

from vlatool.bundle.bundle import Bundle
from vlatool.stage.finish import history

BOARD = "board"
"""Option of a stage that predicts instead of measuring."""
OPTION = "control"
"""Option of a stage that says so, whatever it is but ``none``, its default."""


def controls(bundle: Bundle) -> tuple[str, ...]:
    """Return a sentence for each stage of a bundle's build record that was a control; none for a bundle to be used."""
    named = ((entry["stage"], entry.get("options", {}).get(OPTION)) for entry in history(bundle))
    return tuple(
        f"a control, not for a robot: {stage} was run with --{OPTION} {value}" for stage, value in named if value
    )


PRUNED_KEY = "pruned"
"""Key of what a stage that removes parts of a policy records: the shares of the work ``asked`` for and ``reached``."""


def removed_by(bundle: Bundle) -> tuple[str, ...]:
    """Return a sentence for each stage of a bundle's build record that was to remove a share of the work."""
    recorded = ((entry["stage"], entry[PRUNED_KEY]) for entry in history(bundle) if PRUNED_KEY in entry)
    return tuple(
        f"{stage}: asked for {work['asked']:.1%} less work, reached {work['reached']:.1%}" for stage, work in recorded
    )


def predicted_for(bundle: Bundle) -> tuple[str, ...]:
    """Return a sentence for each stage of a bundle's build record that chose by what is predicted for a board."""
    named = ((entry["stage"], entry.get("options", {})) for entry in history(bundle))
    return tuple(
        f"{stage} chose what stays by predictions for {options[BOARD]} (target {options['target_ms']:g} ms), not by "
        "measurements"
        for stage, options in named if options.get(BOARD) and "target_ms" in options
    )  # fmt: skip
