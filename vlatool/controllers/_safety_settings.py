"""Which settings a safety monitor takes: none with which a condition of its table could not come true."""

from __future__ import annotations

import math
from typing import Any

from vlatool.controllers._free_way import REACH_M, STEP_M
from vlatool.controllers._freshness import CLOCK_STEP_S
from vlatool.controllers._settings import check_range
from vlatool.errors import UsageError

RANGES: dict[str, tuple[float, float]] = {
    "rate": (5.0, 1000.0), "radius_m": (0.02, 5.0), "margin_m": (0.0, 1.0), "warning_m": (STEP_M, REACH_M),
    "camera_height_m": (0.02, 5.0), "camera_forward_m": (-5.0, 5.0), "camera_hfov_deg": (10.0, 170.0),
    "scan_yaw_deg": (-360.0, 360.0), "scan_forward_m": (-5.0, 5.0), "top_m": (0.0, 10.0), "cliff_m": (0.01, 0.5),
    "max_linear_speed": (0.01, 5.0), "max_angular_speed": (0.01, 20.0), "max_age_s": (0.05, CLOCK_STEP_S),
    "command_s": (0.05, 5.0), "silence_s": (0.05, 60.0), "fence_warning_m": (0.0, 1e6), "task_s": (0.1, 1e9),
}  # fmt: skip
"""Setting -> least and largest value. A way is looked at for ``REACH_M``, and beyond ``CLOCK_STEP_S`` no stamp ages."""
ORDERS: tuple[tuple[str, float, tuple[str, ...], float], ...] = (
    ("bands", STEP_M, ("emergency_m", "critical_m", "warning_m"), REACH_M),
    ("charges", 0.0, ("battery_emergency", "battery_critical", "battery_warning"), 1.0),
    ("currents", 0.0, ("current_critical_a", "current_emergency_a"), 1e6),
    ("heights of obstacles", 0.0, ("cliff_m", "top_m"), 10.0),
)
"""Name of settings -> least value, those that may not fall, largest value."""


def check_settings(monitor: Any) -> None:
    """Raise UsageError where a setting is out of its range, or settings are out of their order."""
    for name, (low, high) in RANGES.items():
        check_range(name, getattr(monitor, name), low, high)
    for what, low, names, high in ORDERS:
        values = [getattr(monitor, name) for name in names]
        if not all(one <= two for one, two in zip([low, *values], [*values, high], strict=True)):
            raise UsageError(
                f"The {what} are {', '.join(f'{value:g}' for value in values)}; allowed: "
                f"{' <= '.join([f'{low:g}', *names, f'{high:g}'])}.",
                "change the one that is out of order",
            )


def read_fence(text: str) -> tuple[float, ...]:
    """Return the sides of a fence; empty for none. Raises UsageError for what is not a rectangle."""
    if not text:
        return ()
    try:
        fence = tuple(float(part) for part in text.split(","))
    except ValueError:
        fence = ()
    if len(fence) != 4 or not (fence[0] < fence[2] and fence[1] < fence[3] and all(map(math.isfinite, fence))):
        raise UsageError(
            f"The fence is '{text}'; allowed: X_MIN,Y_MIN,X_MAX,Y_MAX in metres.", "write for example fence='-2,-2,2,2'"
        )
    return fence
