"""Processes of a trial with an arm on a bus: the simulated robot, its controller, and an operator that looks on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from _reach_training import chain_of
from _ros1 import hear_interrupts

from vlatool.buses import QoS, Reception, open_bus
from vlatool.errors import BusError
from vlatool.messages.geometry_msgs import Point, Pose, PoseStamped
from vlatool.messages.joints import joint_values
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import String
from vlatool.messages.std_srvs import TriggerRequest, TriggerResponse
from vlatool.messages.trajectory_msgs import JointTrajectory

COMMANDS = "/joint_trajectory_controller/joint_trajectory"
QUALITY = QoS(reliable=True, depth=10)
REMEMBERED = 2000
"""Messages of each kind that an operator remembers: 20 s of joint states."""


class Process:
    """A command of vlatool that runs.

    Args:
        command: Its arguments.
        log: File of both of its streams; standard error follows in the same name with ``.err``.
    """

    def __init__(self, command: list[str], log: Path) -> None:
        self._out, self._err = log, log.with_suffix(".err")
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "vlatool", *command], stdout=out, stderr=err, preexec_fn=hear_interrupts
            )

    @property
    def said(self) -> str:
        """What it wrote to standard error so far."""
        return self._err.read_text()

    @property
    def answer(self) -> str:
        """What it wrote to standard output so far."""
        return self._out.read_text()

    def runs(self) -> bool:
        """Return whether it runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """End it as ``kill -9`` does."""
        self._process.kill()
        self._process.wait()

    def end(self, number: int = signal.SIGINT, timeout_s: float = 30.0) -> int:
        """Send a signal, and return the exit code; 128 and its number where the signal ended it."""
        if self.runs():
            os.kill(self._process.pid, number)
        return self.exit_code(timeout_s)

    def exit_code(self, timeout_s: float) -> int:
        """Wait for its end, and return the exit code; -1 where it does not end."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return -1
        return 128 - code if code < 0 else code

    def __enter__(self) -> Process:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.runs():
            self.kill()


class Seen(NamedTuple):
    """What an operator saw, and when, by ``time.monotonic``."""

    time_s: float
    value: Any


class Operator:
    """A node that publishes targets, calls the service, and remembers joint states, commands and statuses.

    Args:
        bus: Bus, as ``open_bus`` takes it.
        name: Name of the controller.
        robot: Its ``ROBOT``.
    """

    def __init__(self, bus: str, name: str, robot: Any) -> None:
        self._bus, self._robot = open_bus(bus, "operator"), robot
        self._service = f"/vlatool_{name}/return_to_start"
        self._chains = {side: chain_of(name, robot, side) for side in robot.chains}
        self.states: deque[Seen] = deque(maxlen=REMEMBERED)
        self.commands: deque[Seen] = deque(maxlen=REMEMBERED)
        self.statuses: deque[Seen] = deque(maxlen=REMEMBERED)
        self._send = {
            side: self._bus.publisher(f"/{side}/target" if side else "/target", PoseStamped, QUALITY)
            for side in robot.chains
        }
        self._bus.subscribe("/joint_states", JointState, self._take_state, QoS(depth=10))
        self._bus.subscribe(COMMANDS, JointTrajectory, self._take_command, QUALITY)
        self._bus.subscribe(f"/vlatool_{name}/steps", String, self._take_step, QoS(reliable=True, depth=100))

    def _take_state(self, got: Reception) -> None:
        self.states.append(Seen(got.received_s, got.message))

    def _take_command(self, got: Reception) -> None:
        message: Any = got.message
        state = JointState(message.header, message.joint_names, message.points[-1].positions)
        self.commands.append(Seen(got.received_s, joint_values(state, self._robot.driver_names)))

    def _take_step(self, got: Reception) -> None:
        message: Any = got.message
        self.statuses.append(Seen(got.received_s, json.loads(message.data).get("status", "")))

    def aim(self, target: np.ndarray) -> None:
        """Publish where the tips are to go, (3,) or (6,) in metres, once."""
        for index, send in enumerate(self._send.values()):
            place = Point(*map(float, target[3 * index : 3 * index + 3]))
            send(PoseStamped(pose=Pose(position=place)))

    def return_to_start(self, timeout_s: float) -> TriggerResponse:
        """Call the service.

        Raises:
            BusError: when nobody answers in time.
        """
        return self._bus.call(self._service, TriggerRequest(), TriggerResponse, timeout_s)

    def positions(self) -> np.ndarray:
        """Return the newest positions (A,) in the order of the robot."""
        return joint_values(self.states[-1].value, self._robot.driver_names)

    def velocities(self, since_s: float) -> np.ndarray:
        """Return the velocities (K, A) of all joint states since a time."""
        seen = [each.value for each in list(self.states) if each.time_s >= since_s]
        return np.array([joint_values(state, self._robot.driver_names, "velocity") for state in seen])

    def distance(self, target: np.ndarray) -> float:
        """Return how far the farthest tip is from its target, in metres."""
        positions, places = self.positions(), target.reshape(-1, 3)
        tips = [chain.tip_position(positions[self._robot.places(side)]) for side, chain in self._chains.items()]
        return max(float(np.linalg.norm(tip - place)) for tip, place in zip(tips, places, strict=True))

    @property
    def status(self) -> str:
        """The newest status of the controller; empty before the first one."""
        return str(self.statuses[-1].value) if self.statuses else ""

    def wait(self, holds: Callable[[], bool], timeout_s: float) -> float:
        """Wait until something holds; return how long it took, infinity where it does not."""
        began = time.monotonic()
        while time.monotonic() - began < timeout_s:
            if holds():
                return time.monotonic() - began
            time.sleep(0.02)
        return float("inf")

    def stands(self, seconds: float, rad_per_s: float = 0.02) -> bool:
        """Return whether no joint moved in the last seconds."""
        velocities = self.velocities(time.monotonic() - seconds)
        return len(velocities) > 10 and float(np.abs(velocities).max()) < rad_per_s

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()


def open_operator(bus: str, name: str, robot: Any, timeout_s: float = 20.0) -> Operator:
    """Return an operator, as soon as the bus takes one; raises BusError where it does not in time."""
    end = time.monotonic() + timeout_s
    while True:
        try:
            return Operator(bus, name, robot)
        except BusError:
            if time.monotonic() > end:
                raise
            threading.Event().wait(0.3)
