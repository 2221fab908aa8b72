"""What an environment tells of the robot's body in the info of its steps, read with care: a wrong number is none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.motion.track import Track
from vlatool.runtime.interface import Array

SERIES = {"position": 1, "joints": 1, "heading": 0, "gripper": 0, "collision": 0}
"""What the info of a step may tell -> number of its axes."""
MAX_ELEMENTS = {"position": 3, "joints": 64}
"""Elements that they may have."""
TIME, SHORTEST = "time", "shortest_path"
MAX_SERIES_STEPS = 2000
"""Steps of an episode that is shown."""
MAX_UNEVENNESS = 0.01
"""Share by which two steps of an environment's clock may differ."""


class Body:
    """Listens to an episode and tells it as a track; ``spec`` has names, units and rate of its actions."""

    def __init__(self, spec: PolicySpec) -> None:
        self._hz = float(spec.rate)
        self._alike, self._grip = same_unit_elements(spec.action), spec.action.gripper
        self._told: dict[str, list[Array]] = {name: [] for name in SERIES}
        self._times: list[float] = []
        self._shortest: float | None = None
        self._actions: list[Array] = []
        self._fresh: list[bool] = []
        self._looks = 0
        self.refused: dict[str, str] = {}
        """What was told and could not be used -> why."""

    def look(self, info: Any) -> None:
        """Read the info of the reset, or of a step."""
        self._looks += 1
        if not isinstance(info, Mapping):
            return
        for name in SERIES:
            if info.get(name) is not None and name not in self.refused:
                self._keep(name, info[name])
        if info.get(TIME) is not None and (time := self._number(TIME, info[TIME])) is not None:
            self._times.append(time)
        if self._shortest is None and info.get(SHORTEST) is not None:
            self._shortest = self._number(SHORTEST, info[SHORTEST], least=0.0)

    def add_action(self, action: Array, fresh: bool) -> None:
        """Keep the action of a step, (A,) or a 0-d index, and whether it was the first of a chunk."""
        self._actions.append(np.asarray(action))
        self._fresh.append(fresh)

    def track(self) -> Track:
        """Return the episode; what was not told at each step is None."""
        actions = np.stack(self._actions)
        kept = {name: series for name in SERIES if (series := self._series(name, len(actions))) is not None}
        if (collision := kept.pop("collision", None)) is not None:
            kept["collision"] = collision[-len(actions) :] != 0
        return Track(
            self._rate(), actions.astype(np.float64) if actions.ndim > 1 else actions, np.array(self._fresh),
            alike=self._alike, grip=self._grip, shortest=self._shortest, **kept,
        )  # fmt: skip

    def _keep(self, name: str, value: Any) -> None:
        array = self._array(name, value)
        if array is None:
            return
        before = self._told[name]
        if before and before[0].shape != array.shape:
            self.refused[name] = f"its shape changes from {list(before[0].shape)} to {list(array.shape)}"
            return
        before.append(array)

    def _array(self, name: str, value: Any) -> Array | None:
        """Return what was told as finite float64 of the right number of axes, None when it is something else."""
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "biuf":
                raise TypeError
            array = array.astype(np.float64)
        except (TypeError, ValueError, RuntimeError):
            self.refused[name] = f"it is {type(value).__name__} and no number, or not a real one"
            return None
        if array.size == 1 and SERIES.get(name, 0) == 0:
            array = array.reshape(())
        if array.ndim != SERIES.get(name, 0) or not 0 < array.size <= MAX_ELEMENTS.get(name, 1):
            wanted = f"(1 to {MAX_ELEMENTS[name]},)" if name in MAX_ELEMENTS else "one number"
            self.refused[name] = f"it has the shape {list(array.shape)}; allowed: {wanted}"
            return None
        if not np.isfinite(array).all() or np.abs(array).max() > 1e9:
            self.refused[name] = "it holds NaN, infinity or a number beyond 1e9"
            return None
        return array

    def _number(self, name: str, value: Any, least: float = -np.inf) -> float | None:
        if name in self.refused or (array := self._array(name, value)) is None:
            return None
        if array < least:
            self.refused[name] = f"it is {float(array):g}; allowed: from {least:g}"
            return None
        return float(array)

    def _series(self, name: str, steps: int) -> Array | None:
        """Return what was told of a name, once for each look or for each step; None when it was not, or not always."""
        told = self._told[name]
        if not told or name in self.refused:
            return None
        if len(told) not in (steps, steps + 1) or self._looks != steps + 1:
            self.refused[name] = f"it is told at {len(told)} of {self._looks} moments"
            return None
        return np.stack(told)

    def _rate(self) -> float:
        """Return the control rate: that of the environment's clock where it has one, or that of the spec."""
        if len(self._times) < 2 or TIME in self.refused:
            return self._hz
        steps = np.diff(self._times)
        if len(self._times) != self._looks and len(self._times) != self._looks - 1:
            self.refused[TIME] = f"it is told at {len(self._times)} of {self._looks} moments"
        elif steps.min() <= 0 or steps.max() - steps.min() > MAX_UNEVENNESS * steps.mean():
            self.refused[TIME] = f"its steps go from {steps.min():g} to {steps.max():g} s; all must be alike, above 0"
        else:
            return float(1 / steps.mean())
        return self._hz


def series_of(track: Track, action: TensorSpec) -> dict[str, tuple[float, ...]]:
    """Return what a drawing of an episode needs: ``position.x``, ``action.NAME`` and ``fresh``, of its first steps.

    Args:
        action: action of the spec; a discrete one gives ``action``, its index.
    """
    series = {"fresh": track.fresh.astype(float)}
    if track.position is not None:
        series |= {f"position.{axis}": values for axis, values in zip("xyz", track.position.T, strict=False)}
    if track.actions.ndim == 1:
        series["action"] = track.actions.astype(float)
    else:
        names = action.labels or tuple(map(str, range(track.actions.shape[1])))
        series |= {f"action.{name}": values for name, values in zip(names, track.actions.T, strict=False)}
    return {name: tuple(np.asarray(values, np.float64)[:MAX_SERIES_STEPS].tolist()) for name, values in series.items()}


def same_unit_elements(action: TensorSpec) -> tuple[int, ...]:
    """Return the elements of a continuous action that share its most frequent unit, the gripper apart."""
    if action.kind == "discrete":
        return ()
    grip, units = action.gripper, action.units()
    movers = [index for index in range(len(units)) if index != grip]
    if not movers:
        return ()
    most = max((units[index] for index in movers), key=lambda unit: sum(units[index] == unit for index in movers))
    return tuple(index for index in movers if units[index] == most)
