"""A controller wrapper that watches for what is unusual: actions, inputs, the confidence of the policy."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import AnomalyAlarm, UsageError
from vlatool.runtime.anomaly import MONITORS, Step, monitors_of
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.interface import Array, Controller, Origin, layers_of, origin_of
from vlatool.runtime.noise_spread import NoiseSpread

CLOSED_ENDS = ("any", "high", "low")


class Anomaly:
    """Passes each action on, and says which monitors raise an alarm at it: in telemetry and, if asked for, by a stop.

    A monitor has nothing to say where the bundle has no statistics, the action no gripper or the policy no logits; a
    limit of 0 leaves one out. ``spread`` infers a second time with other noise, at steps that play a chunk.

    Args:
        z_score: Standard deviations from the mean of the trained actions.
        reversals: Share of the last 20 control steps at which a motion turns.
        stall: Seconds for which the gripper is closed and nothing moves.
        input_shift: Standard deviations by which the recent mean of an input is off.
        entropy: Entropy of logits by that of a uniform draw, mean of 5 inferences.
        spread: Difference of two chunks of other noise, in standard deviations of the trained actions; 0 for never.
        closed: Which commands of the gripper close it: ``high``, ``low`` or ``any``.
        escalate: Whether ``act`` raises when an alarm has lasted for ``after`` control steps in a row, so that the
            envelope around it stops the robot.
        after: See ``escalate``.
        clock: Returns seconds.

    Raises:
        UsageError: when a number is out of its range, or ``closed`` is another word.
        SpecError: when statistics of the bundle are missing or do not fit.
    """

    def __init__(
        self, controller: Controller, *, z_score: float = 8.0, reversals: float = 0.7, stall: float = 10.0,
        input_shift: float = 4.0, entropy: float = 0.95, spread: float = 0.0, closed: str = "any",
        escalate: bool = False, after: int = 3, spec: PolicySpec | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        limits = dict(zip(MONITORS, (z_score, reversals, stall, input_shift, entropy), strict=True))
        for name, limit in {**limits, "spread": spread}.items():
            check_positive(name, limit, "a number", zero=True)
        check_whole("after", after, 1)
        if closed not in CLOSED_ENDS:
            raise UsageError.unknown(f"closed is '{closed}'", closed, CLOSED_ENDS)
        inside = layers_of(controller)
        self.controller = controller
        self.spec: PolicySpec = spec or inside[-1].spec
        self.alarms: tuple[str, ...] = ()
        """Names of the monitors that raise an alarm at the last step."""
        self.scores: dict[str, float] = {}
        """Name of a monitor -> its score at the last step, where it had one."""
        self._clock, self._escalates, self._after, self._lasted = clock, escalate, after, 0
        self._player = next((layer for layer in inside if hasattr(layer, "played")), None)
        self.monitors = monitors_of(self.spec, _bundle_of(inside), limits, closed)
        """What looks at each step."""
        self._spread = NoiseSpread.of(inside, spread, self.spec) if spread else None

    @property
    def fresh(self) -> bool:
        """Whether the last action was the first of a chunk."""
        return self.controller.fresh

    @property
    def origin(self) -> Origin:
        """Where the last action came from."""
        return origin_of(self.controller)

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the controller's action.

        Raises:
            AnomalyAlarm: when alarms have lasted for ``after`` steps and ``escalate`` is set.
            Exception: as the controller's ``act`` does.
        """
        action = self.controller.act(observation)
        self._watch(observation, action)
        self._lasted = self._lasted + 1 if self.alarms else 0
        if self._escalates and self._lasted >= self._after:
            name = self.alarms[0]
            raise AnomalyAlarm(f"The monitor {name} has {self.scores[name]:.3g}; its limit is {self._limit(name):g}.")
        return action

    def _limit(self, name: str) -> float:
        return next(each.limit for each in (*self.monitors, self._spread) if each is not None and each.name == name)

    def _watch(self, observation: Mapping[str, Any], action: Array) -> None:
        played = self._player.played if self._player is not None and self.fresh else None
        numbers = np.ravel(action).tolist()
        step = Step(observation, numbers, None if played is None else played.outputs, self._clock())
        self.scores = {}
        for monitor in self.monitors:
            try:
                score = monitor.score(step)
            except Exception:  # the seam: what cannot be judged is unusual, and no reason to have no action
                score = float("inf")
            if score is not None:
                self.scores[monitor.name] = score
        if self._spread is not None and not self.fresh and (score := self._spread.score(observation)) is not None:
            self.scores[self._spread.name] = score
        self.alarms = tuple(name for name, score in self.scores.items() if not score <= self._limit(name))

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode."""
        self.controller.reset(seed)
        for monitor in self.monitors:
            monitor.reset()
        self.alarms, self.scores, self._lasted = (), {}, 0


def _bundle_of(layers: Sequence[Any]) -> Any:
    """Return the bundle inside some layers, which has the statistics; None where there is none."""
    return next((layer.bundle for layer in layers if hasattr(layer, "bundle")), None)
