"""What the controller of an arm remembers from step to step."""

from __future__ import annotations

from typing import NamedTuple

from vlatool.controllers._arm_return import Return
from vlatool.controllers._arm_track import Track
from vlatool.controllers._freshness import Changes
from vlatool.runtime.envelope import Envelope

WAITING, RETURNING, ACTING, HALT = "waiting", "returning", "acting", "stopped"
"""No joint state yet; on the way to the start pose; with the policy; until the service is called."""


class ArmState(NamedTuple):
    """The state of an arm's controller.

    Args:
        phase: ``waiting``, ``returning``, ``acting`` or ``stopped``.
        detail: What it does in this phase, or waits for, in words.
        envelope: What was commanded, and the stop behind it; None before the first joint state. Each step goes on with
            a copy, so that a state can be used again.
        way: Way to the start pose; None before it is planned.
        attempts: Ways to the start pose that the envelope ended.
        changes: When each input last changed.
        last_s: Time of the last command, in seconds of the snapshots.
        calls: Numbers of the calls that wait for the start pose.
        silent_since_s: When there was last no joint state that it can use, and none since; None while there are some.
        track: Joint states that were believed.
    """

    phase: str = WAITING
    detail: str = ""
    envelope: Envelope | None = None
    way: Return | None = None
    attempts: int = 0
    changes: Changes = {}
    last_s: float = 0.0
    calls: tuple[int, ...] = ()
    silent_since_s: float | None = None
    track: Track = Track()
