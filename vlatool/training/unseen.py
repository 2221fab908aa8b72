"""How far a student is from its teacher in episodes that it has not trained on: whether more of them would help."""

from __future__ import annotations

from typing import Any

from vlatool.training.batches import Loss, mean_loss
from vlatool.training.device import Device
from vlatool.training.frames import Frames

MOST = 1024
"""Rows of a round that are looked at."""
APART = 1.5
"""Times the loss on rows that were trained on, above which more episodes are advised."""
KEY = "loss"
NEW, BEFORE = "new", "before"
"""Of a round that the student has just played, and of its round before, on which it has trained since."""


def unseen_losses(frames: Frames, number: int, loss: Loss, rows: int, device: Device) -> dict[str, float]:
    """Return the mean losses of rows of the student's last two rounds; of the last one alone where it is the first.

    Args:
        frames: All rounds, the last one not trained on yet.
        number: Of the last round.
        loss: Of a batch.
        rows: At a time.
        device: As in training.
    """
    played = {NEW: number} | ({BEFORE: number - 1} if number > 1 else {})
    places = {name: frames.sample((round_,), MOST) for name, round_ in played.items()}
    return {name: mean_loss(frames, each, loss, rows, device) for name, each in places.items()}


def unseen_lines(rounds: list[dict[str, Any]]) -> tuple[str, ...]:
    """Say how the last losses differ, and what to do about it."""
    told = [about[KEY] for about in rounds if BEFORE in about.get(KEY, {})]
    if not told:
        return ()
    new, before = told[-1][NEW], told[-1][BEFORE]
    more = "; more episodes may help (--episodes, --student-episodes)" if new > APART * before else ""
    return (f"loss on new episodes of the student's {new:.4g}, on those before, trained on since, {before:.4g}{more}",)
