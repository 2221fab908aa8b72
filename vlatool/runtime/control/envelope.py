"""A controller whose actions stay in the envelope of its robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.errors import DataError, UsageError
from vlatool.runtime.envelope import Envelope, Level, StepResult
from vlatool.runtime.envelope.envelope import FLOATS
from vlatool.runtime.interface import STOP, Array, Controller, Origin, origin_of

Measurement = str | Callable[[Mapping[str, Any]], Any]


class EnvelopeController:
    """Passes each action of a controller through an envelope.

    The envelope keeps what was commanded, so it stays the same when the controller is reset or replaced: assign another
    one to ``controller`` while the robot moves. The first ``act`` starts it at the measured position, unless it was
    started before.

    Args:
        controller: whose actions are bounded.
        envelope: of the robot. Its ``max_age_s`` is compared with the age that the controller says (``origin.age_ms``).
        position: where the robot is measured to be, in the units of the limits: an entry of the observation, or a
            function of it. None is enough if no joint has position limits, or the envelope was started.
        readings: values for the monitors of the envelope: a function of the observation; None takes the entries of the
            observation that have their names. Where it raises, there are none, which is critical.
        enabled: returns whether the dead man's switch is held; None if there is none. What it raises, or anything but
            True, stops the robot.

    Raises:
        UsageError: without an envelope.
    """

    def __init__(
        self,
        controller: Controller,
        envelope: Envelope | None = None,
        *,
        position: Measurement | None = None,
        readings: Callable[[Mapping[str, Any]], Mapping[str, float]] | None = None,
        enabled: Callable[[], bool] | None = None,
    ) -> None:
        if not isinstance(envelope, Envelope):
            raise UsageError(
                f"The controller envelope bounds the actions of a robot; its envelope is {type(envelope).__name__}.",
                'pass EnvelopeController(controller, Envelope(RobotLimits.named("franka-panda"), period_s=0.02))',
            )
        self.controller, self.envelope = controller, envelope
        self._position, self._readings, self._enabled = position, readings, enabled
        self.result: StepResult | None = None
        """What the envelope said of the last action: its checks and its level."""
        self.taken_ns = 0
        """Nanoseconds of its last step."""

    @property
    def fresh(self) -> bool:
        """Whether the last action was the first of a chunk."""
        return self.controller.fresh

    @property
    def origin(self) -> Origin:
        """Where the last action came from, as the controller says it, with the checks that touched it."""
        origin, result = origin_of(self.controller), self.result
        if result is None:
            return origin
        origin = origin.altered_by(*result.checks)
        return origin._replace(source=STOP) if result.level >= Level.CRITICAL else origin

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step within the envelope.

        Returns:
            The controller's own array where nothing changed it; else (A,) float64, because positions in float32 have
            steps of 2.4e-7 at 2 to 4 rad, which at 100 Hz are 5e-3 rad/s^2.

        Raises:
            DataError: at the first step, when the measured position is missing or not within the limits.
            VlatoolError: as the controller's ``act`` does; ``stop`` then gives the next step of the proven stop.
        """
        if not self.envelope.ready:
            self.envelope.start(self._measure(observation))
        action = self.controller.act(observation)
        age = getattr(getattr(self.controller, "origin", None), "age_ms", None)
        return self._step(action, self._values(observation), None if age is None else age / 1e3)

    def stop(self) -> Array:
        """Return the next step of the stop that was proven last: (A,) float64.

        For a control step at which the controller raised, or that has no observation.
        """
        return self._step(None, {})

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode of the controller; the robot is where it is, so the envelope goes on."""
        self.controller.reset(seed)

    def _step(self, action: Any, readings: Mapping[str, Any], age_s: float | None = None) -> Array:
        begin = time.perf_counter_ns()
        self.result = result = self.envelope.step(action, readings=readings, enabled=self._held(), age_s=age_s)
        same = isinstance(action, np.ndarray) and action.dtype in FLOATS and action.tolist() == list(result.command)
        sent = action if same else np.array(result.command)
        self.taken_ns = time.perf_counter_ns() - begin
        return sent

    def _held(self) -> bool | None:
        """Return whether the dead man's switch is held; None if there is none."""
        if self._enabled is None:
            return None
        try:
            held = self._enabled()
        except Exception:  # the seam: a switch that cannot be read is not held
            return False
        return isinstance(held, bool | np.bool_) and bool(held)

    def _measure(self, observation: Mapping[str, Any]) -> Any:
        if self._position is None:
            return None
        if callable(self._position):
            return self._position(observation)
        if self._position not in observation:
            raise DataError(
                f"The observation has no '{self._position}', where the robot's position is to be.",
                "give the measured position at the first step, or call envelope.start(position)",
            )
        return self._newest(observation[self._position])

    def _newest(self, measured: Any) -> Any:
        """Return the position (A,) float64, the newest where there are several; anything else as it is."""
        width = len(self.envelope.limits.joints)
        try:
            values = np.asarray(measured, np.float64)
        except (TypeError, ValueError):
            return measured
        return values.reshape(-1, width)[-1] if values.shape[-1:] == (width,) and values.size else np.ravel(values)

    def _values(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        if self._readings is not None:
            try:
                return self._readings(observation)
            except Exception:  # the seam: a reading that is missing is critical
                return {}
        names = [monitor.name for monitor in self.envelope.monitors]
        return {name: _scalar(observation[name]) for name in names if name in observation}


def _scalar(value: Any) -> Any:
    """Return the number in an array of one element; anything else as it is."""
    return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
