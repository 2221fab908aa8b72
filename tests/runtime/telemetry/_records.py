"""Records as a stack gives them."""

from typing import Any

import numpy as np

from vlatool.runtime.interface import POLICY, Origin
from vlatool.runtime.telemetry import TickRecord


def record(step: int = 0, **changes: Any) -> TickRecord:
    """Return the record of a control step of 2 ms."""
    origin = Origin(POLICY, 3.5, ("velocity",))
    parts = (0.1, 1.0, 0.2, 0.05, 0.15, 0.25)
    values = TickRecord(step, step * 0.05, 0.25, 2.0, False, 0, 0, origin, "", np.float32([step, 0.5]), 1.5, parts)
    return values._replace(**changes)
