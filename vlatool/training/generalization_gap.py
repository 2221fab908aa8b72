"""The generalization gap: the student's loss on episodes that it has not trained on, and whether more would help."""

from __future__ import annotations

from typing import Any

from vlatool.training.batches import Loss, mean_loss
from vlatool.training.device import Device
from vlatool.training.frames import Frames

MAX_ROWS = 1024
"""Largest number of rows of a round that are used."""
ADVICE_RATIO = 1.5
"""Ratio to the loss on rows that were trained on, above which more episodes are advised."""
LOSS_KEY = "loss"
NEW_ROUND, PREVIOUS_ROUND = "new", "before"
"""Loss on the round that the student has just played, and on the round before, on which it has since trained."""


def last_round_losses(frames: Frames, number: int, loss: Loss, rows: int, device: Device) -> dict[str, float]:
    """Return the mean losses of rows of the student's last two rounds; of the last one alone where it is the first.

    Args:
        frames: all rounds, the last one not trained on yet.
    """
    played = {NEW_ROUND: number} | ({PREVIOUS_ROUND: number - 1} if number > 1 else {})
    indices = {name: frames.sample((round_,), MAX_ROWS) for name, round_ in played.items()}
    return {name: mean_loss(frames, each, loss, rows, device) for name, each in indices.items()}


def gap_lines(rounds: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return a sentence on how the last losses differ, and what to do about it."""
    losses = [about[LOSS_KEY] for about in rounds if PREVIOUS_ROUND in about.get(LOSS_KEY, {})]
    if not losses:
        return ()
    new, before = losses[-1][NEW_ROUND], losses[-1][PREVIOUS_ROUND]
    more = "; more episodes may help (--episodes, --student-episodes)" if new > ADVICE_RATIO * before else ""
    return (f"loss on new episodes of the student's {new:.4g}, on those before, trained on since, {before:.4g}{more}",)
