"""Monitors of what a policy sees and does: each gives a score for a control step, and raises an alarm above its limit.

They find what is unusual, not what is dangerous: an envelope bounds what is sent.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime.assets import Assets
from vlatool.runtime.interface import Array
from vlatool.runtime.statistics import load_normaliser

DEVIATIONS_OF_RANGE = 3.0
"""Half of a recorded range, min to max or between quantiles, counts as so many standard deviations."""
WINDOW = 20
"""Control steps of which reversals are counted."""
LEAST_MOTION = 0.1
"""Share of the usual motion below which a change of direction is noise."""
REST = 1e-3
"""Motion in standard deviations of the action (or in its units, without statistics) that is none."""
MEMORY = 50
"""Control steps after which an observation counts for 1/e in the mean of an input."""
ANSWERS = 5
"""Inferences of which the mean entropy counts."""


class Step(NamedTuple):
    """What monitors see of a control step.

    Args:
        observation: As the controller gets it.
        action: (A,), or a 0-d index of a discrete action, as numbers.
        outputs: Outputs of the inference that this step began with; None where it began with none, or nobody says.
        time: Seconds.
    """

    observation: Mapping[str, Any]
    action: list[float]
    outputs: Mapping[str, Array] | None
    time: float


class Scale(NamedTuple):
    """Mean and standard deviation of each element of a tensor in the data that it was trained on.

    Args:
        mean: In the units of the tensor.
        deviation: The same.
    """

    mean: list[float]
    deviation: list[float]

    @classmethod
    def of(cls, tensor: TensorSpec, assets: Assets | None) -> Scale | None:
        """Return that of a tensor; None where the bundle has no statistics of what the robot gives or gets."""
        if assets is None or tensor.convert or tensor.normalisation == "none":
            return None
        found = load_normaliser(tensor, assets)
        if found is None:
            return None
        share = 1.0 if tensor.normalisation == "mean_std" else 1 / DEVIATIONS_OF_RANGE
        return cls(found.offset.tolist(), [max(scale, 1e-12) * share for scale in found.scale.tolist()])

    def scores(self, values: Sequence[float]) -> list[float]:
        """Return the distance of each element from its mean, in standard deviations."""
        return [(value - mean) / deviation for value, mean, deviation in zip(values, *self, strict=True)]


class AnomalyMonitor:
    """One monitor.

    Args:
        limit: Score above which it raises an alarm.
    """

    name = ""

    def __init__(self, limit: float) -> None:
        self.limit = limit

    def score(self, step: Step) -> float | None:
        """Return the score of a control step; None where it has none."""
        raise NotImplementedError

    def reset(self) -> None:
        """Start a new episode."""


class ZScore(AnomalyMonitor):
    """Distance of the action from the mean of the trained ones, in standard deviations, of the farthest element."""

    name = "z_score"

    def __init__(self, limit: float, scale: Scale) -> None:
        super().__init__(limit)
        self._scale = scale

    def score(self, step: Step) -> float | None:
        """Return the largest distance."""
        return max(map(abs, self._scale.scores(step.action)))


class Reversals(AnomalyMonitor):
    """Share of the last ``WINDOW`` control steps at which the direction of motion turns, of the worst element.

    Of a discrete action, those at which the action before the last one comes again.
    """

    name = "reversals"

    def __init__(self, limit: float, action: TensorSpec) -> None:
        super().__init__(limit)
        self._discrete, self._relative = action.kind == "discrete", action.mode in ("delta", "velocity")
        self._elements = [index for index in range(action.robot_width) if index != action.gripper]
        self.reset()

    def reset(self) -> None:
        """Forget all motion."""
        self._before: list[float] | None = None
        self._moved: list[float] | None = None
        self._usual = [0.0] * len(self._elements)
        self._turns: deque[list[bool]] = deque(maxlen=WINDOW)

    def score(self, step: Step) -> float | None:
        """Return the largest share, once the window is full."""
        moved = self._motion(step.action)
        if moved is not None and self._moved is not None:
            self._turns.append(self._turned(moved, self._moved))
        self._moved = moved or self._moved
        if len(self._turns) < WINDOW:
            return None
        return max(map(sum, zip(*self._turns, strict=True))) / WINDOW

    def _motion(self, action: list[float]) -> list[float] | None:
        if self._discrete:
            return [*(self._moved or [])[-1:], action[0]]
        before, self._before = self._before, action
        if self._relative:
            return [action[index] for index in self._elements]
        return None if before is None else [action[index] - before[index] for index in self._elements]

    def _turned(self, moved: list[float], last: list[float]) -> list[bool]:
        """Return for each element whether its motion turned."""
        if self._discrete:
            return [len(last) > 1 and last[0] == moved[1] != moved[0]]
        usual = self._usual = [0.95 * mean + 0.05 * abs(now) for mean, now in zip(self._usual, moved, strict=True)]
        columns = zip(moved, last, usual, strict=True)
        return [now * before < 0 and min(abs(now), abs(before)) > LEAST_MOTION * mean for now, before, mean in columns]


class Stall(AnomalyMonitor):
    """Seconds for which the gripper has been closed, or as it is, and nothing else has moved.

    Args:
        closed: Which commands of the gripper close it: ``high`` ones, ``low`` ones, or ``any`` where that is unknown.
    """

    name = "stall"

    def __init__(self, limit: float, action: TensorSpec, scale: Scale | None, closed: str) -> None:
        super().__init__(limit)
        self._action, self._closed = action, closed
        self._gripper = action.gripper
        self._middle = 0.0 if scale is None or self._gripper is None else scale.mean[self._gripper]
        deviations = [1.0] * action.robot_width if scale is None else scale.deviation
        self._rest = [REST * value for value in deviations]
        self.reset()

    def reset(self) -> None:
        """Forget how long it has lasted."""
        self._since: float | None = None
        self._before: list[float] | None = None

    def score(self, step: Step) -> float | None:
        """Return the seconds."""
        rests = self._rests(step.action)
        self._before = step.action
        if not rests:
            self._since = None
            return 0.0
        self._since = step.time if self._since is None else self._since
        return step.time - self._since

    def _rests(self, action: list[float]) -> bool:
        before = self._before
        if before is None or self._gripper is None:
            return False
        relative = self._action.mode in ("delta", "velocity")
        for index, (now, last) in enumerate(zip(action, before, strict=True)):
            moved = now if relative and index != self._gripper else now - last
            if abs(moved) > self._rest[index]:
                return False
        high = action[self._gripper] > self._middle
        return self._closed == "any" or (self._closed == "high") is high


class InputShift(AnomalyMonitor):
    """Distance of the recent mean of an input from that of the data, in standard deviations, of the farthest element.

    Args:
        scales: Name of each input with statistics -> them.
    """

    name = "input_shift"

    def __init__(self, limit: float, scales: Mapping[str, Scale]) -> None:
        super().__init__(limit)
        self._scales = dict(scales)
        self.reset()

    def reset(self) -> None:
        """Forget the means."""
        self._means: dict[str, list[float]] = {}
        self._steps = 0

    def score(self, step: Step) -> float | None:
        """Return the largest distance, once a few observations are there."""
        self._steps += 1
        share = 1 / min(self._steps, MEMORY)
        for name, scale in self._scales.items():
            scores = scale.scores(_newest(step.observation[name], len(scale.mean)))
            before = self._means.get(name, scores)
            self._means[name] = [mean + share * (now - mean) for mean, now in zip(before, scores, strict=True)]
        if self._steps < WINDOW:
            return None
        return max(max(map(abs, means)) for means in self._means.values())


class Entropy(AnomalyMonitor):
    """Entropy of the first discrete action of a chunk by that of a uniform draw, mean of the last ``ANSWERS``."""

    name = "entropy"

    def __init__(self, limit: float, logits: str) -> None:
        super().__init__(limit)
        self._logits = logits
        self.reset()

    def reset(self) -> None:
        """Forget the answers."""
        self._last: deque[float] = deque(maxlen=ANSWERS)

    def score(self, step: Step) -> float | None:
        """Return the mean, once the answers are there."""
        if step.outputs is None or self._logits not in step.outputs:
            return None
        self._last.append(relative_entropy(step.outputs[self._logits]))
        return sum(self._last) / ANSWERS if len(self._last) == ANSWERS else None


def relative_entropy(logits: Array) -> float:
    """Return the entropy of softmax(logits) of the first row, (..., N), by ln N: from 0 (certain) to 1."""
    row = [float(value) for value in logits.reshape(-1, logits.shape[-1])[0]]
    top = max(row)
    weights = [math.exp(value - top) for value in row]
    total = sum(weights)
    shares = [weight / total for weight in weights]
    return -sum(share * math.log(share) for share in shares if share > 0) / math.log(max(2, len(shares)))


def _newest(value: Any, width: int) -> list[float]:
    """Return the newest row of an input as numbers."""
    rows = np.asarray(value, np.float64).reshape(-1, width)
    numbers: list[float] = rows[-1].tolist()
    return numbers


MONITORS = tuple(each.name for each in (ZScore, Reversals, Stall, InputShift, Entropy))
"""Names of the monitors that look at each control step."""


def monitors_of(
    spec: PolicySpec, assets: Assets | None, limits: Mapping[str, float], closed: str
) -> list[AnomalyMonitor]:
    """Return the monitors of a policy: those that its spec and its statistics allow.

    Args:
        limits: Name of a monitor -> its limit; 0 leaves it out.
        closed: See ``Stall``.
    """
    action, scale, discrete = spec.action, Scale.of(spec.action, assets), spec.action.kind == "discrete"
    inputs = _scales(spec, assets)
    logits = action.name if discrete else next((each.name for each in spec.outputs if "logit" in each.name.lower()), "")
    found: list[AnomalyMonitor] = [Reversals(limits[Reversals.name], action)]
    if scale is not None and not discrete:
        found.append(ZScore(limits[ZScore.name], scale))
    if action.gripper is not None:
        found.append(Stall(limits[Stall.name], action, scale, closed))
    if inputs:
        found.append(InputShift(limits[InputShift.name], inputs))
    if logits:
        found.append(Entropy(limits[Entropy.name], logits))
    return [monitor for monitor in found if monitor.limit]


def _scales(spec: PolicySpec, assets: Assets | None) -> dict[str, Scale]:
    """Return the statistics of each input that has some."""
    numbers = [tensor for tensor in spec.inputs if tensor.image is None and tensor.kind == "tensor"]
    scales = {tensor.name: Scale.of(tensor, assets) for tensor in numbers}
    return {name: scale for name, scale in scales.items() if scale is not None}
