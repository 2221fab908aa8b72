"""Joints by their names, never by their places in a message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import BusError
from vlatool.messages._names_text import names_text
from vlatool.messages.sensor_msgs import JointState

Array = NDArray[Any]
QUANTITIES = ("position", "velocity", "effort")


def joint_values(message: JointState, names: Sequence[str], quantity: str = "position") -> Array:
    """Return a quantity of named joints, (N,) float64 in the order of the names; other joints do not matter.

    Args:
        message: State of the joints, in any order.
        names: Joints.
        quantity: ``position``, ``velocity`` or ``effort``.

    Raises:
        BusError: when a joint is missing or there twice, or the message lacks the quantity.
    """
    if quantity not in QUANTITIES:
        raise BusError(f"Joints have no {quantity!r}.", f"name one of {', '.join(QUANTITIES)}")
    reported, found = tuple(message.name), getattr(message, quantity)
    if len(found) != len(reported):
        raise BusError(
            f"A JointState with {len(reported)} names and {len(found)} values of {quantity}.",
            f"check that the driver reports the {quantity} of every joint",
        )
    for name in names:
        if (count := reported.count(name)) != 1:
            problem = "without" if not count else f"{count} times with"
            raise BusError(
                f"A JointState {problem} the joint {name!r}; its joints: {names_text(reported)}.",
                "check the joint names of the robot's driver, or map them",
            )
    return np.array([found[reported.index(name)] for name in names], np.float64)
