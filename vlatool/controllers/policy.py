"""Any policy as a controller: topics become its inputs, its actions become the messages that a robot obeys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.controllers._interface import Command, Input, Output, Service, Snapshot
from vlatool.controllers._policy_inputs import stamp_of, value_of
from vlatool.controllers._policy_map import (
    ACTIONS,
    FRAMES,
    PRINT,
    TEXT,
    InputMap,
    OutputMap,
    check_map,
    read_inputs,
    read_output,
)
from vlatool.controllers._policy_outputs import check_action, message_of, stop_of
from vlatool.controllers._policy_proposal import propose
from vlatool.controllers._settings import check_finite, check_range, check_rate
from vlatool.errors import BusError, UsageError, VlatoolError
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.joints import joint_values
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import String
from vlatool.runtime.sensors import SensorLimits, Sensors

Array = NDArray[Any]
CAPACITY = 8
"""Samples of each sensor that are kept."""


class _State(NamedTuple):
    """What changes from step to step.

    Args:
        sensors: Samples of cameras and vectors; None for a policy without such inputs.
        frames: Input -> the last frames, the oldest first.
        actions: Indices of past actions, the oldest first.
        heard: Sequence of the last instruction; -1 before the first.
        problems: Input -> why its newest message was not used.
    """

    sensors: Sensors | None
    frames: Mapping[str, tuple[Array, ...]] = {}
    actions: tuple[int, ...] = ()
    heard: int = -1
    problems: Mapping[str, str] = {}


@dataclass(frozen=True)
class Policy:
    """Runs the policy of a bundle: a map says which topic is which input, and what its actions command.

    Cameras come in any encoding of colours and are resized by the bundle. Joints are found by name, in the units of the
    spec. Samples are brought to one time and refused when they are too old; the robot then stops, and the status says
    why. An action becomes a JointTrajectory of one point, a JointState, or a Twist, by its mode; of a chunk, one action
    at each step.

    Args:
        map: Inputs and output, as in a map.yaml; printed by ``--print-map``.
        rate: Steps in a second; the control rate of the policy when 0.
        skew_s: Largest difference between the times of two inputs, in seconds; not checked when 0.
        settle_s: Time for which the stamps of a sensor have to agree with its arrivals before they count.
        policy: What ``vlatool.load`` returned.

    Raises:
        UsageError: for an input or an element of the action that the map does not have, by its name.
    """

    map: Mapping[str, Any] = field(default_factory=dict)
    rate: float = 0.0
    skew_s: float = 0.0
    settle_s: float = 0.5
    policy: Any = field(default=None, metadata={"setting": False})

    def __post_init__(self) -> None:
        check_finite(self)
        check_map(self.map)
        check_range("skew_s", self.skew_s, 0.0)
        check_range("settle_s", self.settle_s, 0.0)
        if self.rate:
            check_rate(self.rate)
        if self.policy is not None:
            _ = self._inputs, self._output, self._joints

    @property
    def _spec(self) -> Any:
        if self.policy is None:
            raise UsageError("The controller has no policy; allowed: one that vlatool.load returned.",
                             "name a bundle: --bundle DIR")  # fmt: skip
        return self.policy.spec

    @cached_property
    def _inputs(self) -> tuple[InputMap, ...]:
        return read_inputs(self.map, self._spec)

    @cached_property
    def _output(self) -> OutputMap:
        return read_output(self.map, self._spec)

    @cached_property
    def _joints(self) -> str:
        """Input that says where the joints are that are commanded; empty without one."""
        found = next((entry.name for entry in self._inputs if entry.message is JointState), "")
        if self._output.mode == "delta" and not found:
            raise UsageError("The actions are differences, and no input of the map is a JointState.", PRINT)
        return found

    @staticmethod
    def propose(spec: PolicySpec) -> dict[str, Any]:
        """Return a map proposed by the names, units and modes of a spec, for a person to check against the robot.

        Raises:
            UsageError: for an input that no topic can be.
        """
        return propose(spec)

    @property
    def rate_hz(self) -> float:
        """Steps in a second."""
        return self.rate or float(self._spec.rate)

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The topics of the map."""
        return tuple(Input(entry.name, entry.topic, entry.message, depth=1 if entry.kind == TEXT else CAPACITY,
                           reliable=entry.kind == TEXT, latched=entry.kind == TEXT)
                     for entry in self._inputs if entry.topic)  # fmt: skip

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The topic that the map names for the action."""
        return (Output("action", self._output.topic, self._output.message),)

    @property
    def services(self) -> tuple[Service, ...]:
        """Nothing."""
        return ()

    def start(self) -> _State:
        """Return the state before the first message; the policy is reset."""
        self.policy.reset()
        limits = {entry.name: SensorLimits(entry.stale_s, entry.noisy, settle_s=self.settle_s, capacity=CAPACITY)
                  for entry in self._inputs if entry.topic and entry.kind != TEXT}  # fmt: skip
        return _State(Sensors(limits, self.skew_s or None) if limits else None)

    def step(self, snapshot: Snapshot, state: _State) -> tuple[Command, _State]:
        """Return what the policy does now; a stop, and why, where an input is missing or the policy fails."""
        state = self._take(snapshot, state)
        observation, problem = self._observation(snapshot, state)
        if problem:
            return self._stop(snapshot, problem), state
        try:
            action = self._act(observation)
            check_action(self._output, action)
            positions = self._positions(snapshot)
            message = message_of(self._output, action, snapshot.stamp, 1 / self.rate_hz, positions)
        except VlatoolError as error:
            return self._stop(snapshot, f"stopped: {error.message}"), state
        frames = {entry.name: tuple(observation[entry.name][1:]) for entry in self._inputs if entry.kind == FRAMES}
        state = state._replace(frames=frames)
        if self._output.labels:
            state = state._replace(actions=(*state.actions, int(np.asarray(action).reshape(-1)[0]))[-64:])
        origin = getattr(self.policy, "origin", None)
        source = getattr(origin, "source", "") or "policy"
        return Command({"action": (message,)}, status=f"acting {source}", notes={"source": source}), state

    def rest(self) -> Command:
        """Stop."""
        return Command({"action": stop_of(self._output, Time())}, status="stopped")

    def _act(self, observation: Mapping[str, Any]) -> Array:
        if hasattr(self.policy, "act"):
            return np.asarray(self.policy.act(observation))
        chunk: Array = np.asarray(self.policy.infer(observation).chunk)
        return np.asarray(chunk[0])

    def _stop(self, snapshot: Snapshot, why: str) -> Command:
        try:
            positions = self._positions(snapshot)
        except BusError:
            positions = None
        stale_s = next((entry.stale_s for entry in self._inputs if entry.name == self._joints), 0.0)
        if positions is not None and snapshot.age_s(self._joints) > stale_s:
            positions = None  # where they were is not where they are
        return Command({"action": stop_of(self._output, snapshot.stamp, positions)}, status=why)

    def _positions(self, snapshot: Snapshot) -> Array | None:
        """Return where the commanded joints are, in SI units; None where no input says so.

        Raises:
            BusError: where a joint is missing, or its position is not finite.
        """
        wanted = self._output.mode == "delta" or self._output.message is JointState
        joints = snapshot.message(self._joints, JointState) if wanted and self._joints else None
        if joints is None:
            return None
        values = joint_values(joints, self._output.names)
        if not np.isfinite(values).all():
            name = self._output.names[int(np.flatnonzero(~np.isfinite(values))[0])]
            raise BusError(f"The position of the joint {name!r} is not finite.", "check the robot's driver")
        return values

    def _take(self, snapshot: Snapshot, state: _State) -> _State:
        """Return the state with the messages that came."""
        sensors = None if state.sensors is None else state.sensors.copy(lambda: snapshot.time_s)
        frames, problems = dict(state.frames), dict(state.problems)
        for entry in self._inputs:
            for reading in snapshot.readings.get(entry.name, ()) if entry.kind != TEXT else ():
                try:
                    value = value_of(entry, reading.message)
                except VlatoolError as error:
                    problems[entry.name] = error.message
                    continue
                problems.pop(entry.name, None)
                if sensors is not None:
                    sensors.add(entry.name, value, stamp_of(reading.message), reading.received_s)
        heard = state.heard
        for entry in self._inputs:
            newest = snapshot.newest.get(entry.name) if entry.kind == TEXT else None
            if newest is not None and newest.sequence != state.heard:
                self.policy.reset()
                heard, frames, state = newest.sequence, {}, state._replace(actions=())
        return state._replace(sensors=sensors, frames=frames, heard=heard, problems=problems)

    def _observation(self, snapshot: Snapshot, state: _State) -> tuple[dict[str, Any], str]:
        """Return the observation, or why there is none."""
        values: dict[str, Any] = {}
        if state.sensors is not None:
            reading = state.sensors.read()
            problems = [state.problems[name] for name in state.problems] or list(reading.problems)
            if problems:
                return values, f"waiting: {problems[0]}"
            values.update(reading.observation)
        for entry in self._inputs:
            if entry.kind == TEXT:
                heard = snapshot.message(entry.name, String)
                values[entry.name] = entry.text if not entry.topic else "" if heard is None else heard.data.strip()
                if not values[entry.name]:
                    return values, f"waiting: no instruction on {entry.topic}"
            elif entry.kind == ACTIONS:
                values[entry.name] = self._past(entry, state)
            elif entry.kind == FRAMES:
                values[entry.name] = np.stack(self._moments(entry, state, values[entry.name]))
        return values, ""

    @staticmethod
    def _moments(entry: InputMap, state: _State, frame: Array) -> list[Array]:
        """Return the last frames with this one, the oldest first; black before the first."""
        recent = [*state.frames.get(entry.name, ()), frame][-entry.count :]
        return [np.zeros_like(frame)] * (entry.count - len(recent)) + recent

    def _past(self, entry: InputMap, state: _State) -> Array:
        """Return the past actions, (N,) int64; the number of labels stands for one before the first."""
        recent = list(state.actions)[-entry.count :]
        return np.array([len(self._spec.action.labels)] * (entry.count - len(recent)) + recent, np.int64)
