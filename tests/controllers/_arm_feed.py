"""An arm that goes where it is told at once, a policy that says what a test wants, and the loop of both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.controllers import Command, Reading, Request, Snapshot
from vlatool.messages import Message
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header
from vlatool.messages.std_srvs import TriggerRequest


def spec_of(joints: tuple[str, ...], mode: str = "absolute", *others: TensorSpec, **action: Any) -> PolicySpec:
    state = TensorSpec("state", (1, len(joints)), labels=joints)
    return PolicySpec(
        (state, *others), (TensorSpec("action", (1, 1, len(joints)), labels=joints, mode=mode, **action),), 50.0
    )


class Scripted:
    """A policy whose action is a function of the observation."""

    def __init__(self, spec: PolicySpec, act: Callable[[dict[str, Any]], Any]) -> None:
        self.spec, self._act, self.resets, self.seen = spec, act, 0, []

    def reset(self, seed: int | None = None) -> None:
        self.resets += 1

    def act(self, observation: dict[str, Any]) -> Any:
        self.seen.append(observation)
        return self._act(observation)


def joint_state(names: tuple[str, ...], positions: Any, stamp_s: float = 0.0) -> JointState:
    return JointState(Header(Time.from_seconds(stamp_s)), tuple(names), np.array(positions, np.float64))


class Arm:
    """Steps a controller of an arm that reports each command back as its state.

    Args:
        controller: The controller.
        positions: Where the arm is, in the order of the robot's joints.
        order: Order of the joints in its messages.
    """

    def __init__(self, controller: Any, positions: Any = None, order: Any = None) -> None:
        self.controller, self.state = controller, controller.start()
        robot = controller.ROBOT
        self.names = controller.joint_names or robot.driver_names
        self.positions = np.array(robot.start if positions is None else positions, np.float64)
        self.order = list(range(len(self.names))) if order is None else list(order)
        self.time_s, self.number, self.newest, self.commands = 0.0, 0, {}, []

    def step(
        self, *, silent: bool = False, calls: int = 0, state: Message | None = None, **messages: Message
    ) -> Command:
        """One step; ``silent`` leaves the joint state out, ``state`` sends another one."""
        self.time_s += 1.0 / self.controller.rate
        report = joint_state([self.names[i] for i in self.order], self.positions[self.order], self.time_s)
        arrived = messages if silent else {"joints": state or report, **messages}
        for name, message in arrived.items():
            self.newest[name] = Reading(message, self.time_s, self.number)
        requests = tuple(Request("return_to_start", TriggerRequest(), self.number + index) for index in range(calls))
        self.number += 1
        snapshot = Snapshot(self.time_s, Time.from_seconds(self.time_s), {}, dict(self.newest), requests)
        command, self.state = self.controller.step(snapshot, self.state)
        sent = self.sent(command)
        self.positions = self.positions if sent is None else sent
        self.commands.append(command)
        return command

    def steps(self, count: int, **options: Any) -> Command:
        for _ in range(count):
            command = self.step(**options)
        return command

    def until(self, phase: str, most: int = 2000) -> Command:
        """Step until it is in a phase."""
        for _ in range(most):
            command = self.step()
            if self.state.phase == phase:
                return command
        raise AssertionError(f"not {phase} after {most} steps: {command.status}")

    @staticmethod
    def sent(command: Command) -> np.ndarray | None:
        """The positions of a command; None where it has none."""
        for messages in command.messages.values():
            (message,) = messages
            return message.position if isinstance(message, JointState) else message.points[0].positions
        return None

    def path(self) -> np.ndarray:
        return np.array([sent for command in self.commands if (sent := self.sent(command)) is not None])
