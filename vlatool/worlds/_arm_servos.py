"""Servos of simulated arms: positions that are commanded become controls of the actuators of a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
BANDWIDTH = 40.0
"""Of the position control that stands for the robot's own, in rad/s, critically damped."""


class Setpoint:
    """Positions between two commands: straight from where it is to the command, in the time that the command says."""

    def __init__(self, positions: Array) -> None:
        self._begin = self._end = positions.copy()
        self._began_s, self._ends_s = 0.0, 0.0

    def aim(self, positions: Array, now_s: float, seconds: float) -> None:
        """Go to positions (A,) in a time."""
        self._begin, _ = self.at(now_s)
        self._end, self._began_s, self._ends_s = positions.copy(), now_s, now_s + seconds

    def at(self, now_s: float) -> tuple[Array, Array]:
        """Return positions and velocities (A,) at a time."""
        if now_s >= self._ends_s:
            return self._end, np.zeros_like(self._end)
        length = self._ends_s - self._began_s
        share = (now_s - self._began_s) / length
        return self._begin + share * (self._end - self._begin), (self._end - self._begin) / length


class PositionServos:
    """Actuators of the kind ``position``: the command is their control."""

    def __init__(self, mujoco: Any, model: Any, joints: Sequence[int]) -> None:
        self._controls = _actuators(model, joints)

    def control(self, data: Any, positions: Array, velocities: Array) -> None:
        """Set the controls for positions (A,)."""
        data.ctrl[self._controls] = positions


class TorqueServos:
    """Actuators of the kind ``motor``: torques of a computed-torque law, within what each motor can.

    tau = M(q) (w^2 (q_d - q) + 2 w (v_d - v)) + bias(q, v), as the controller of the robot itself compensates gravity
    and inertia (Siciliano et al., "Robotics: Modelling, Planning and Control", section 8.5.2).
    """

    def __init__(self, mujoco: Any, model: Any, joints: Sequence[int]) -> None:
        self._mujoco, self._model = mujoco, model
        self._controls = _actuators(model, joints)
        self._places, self._speeds = model.jnt_qposadr[list(joints)], model.jnt_dofadr[list(joints)]
        self._inertia, self._square = np.zeros((model.nv, model.nv)), np.ix_(self._speeds, self._speeds)
        self._least, self._most = model.actuator_ctrlrange[self._controls].T

    def control(self, data: Any, positions: Array, velocities: Array) -> None:
        """Set the controls for positions and velocities (A,)."""
        self._mujoco.mj_fullM(self._model, self._inertia, data.qM)
        error, slip = positions - data.qpos[self._places], velocities - data.qvel[self._speeds]
        wanted = BANDWIDTH**2 * error + 2.0 * BANDWIDTH * slip
        torques = self._inertia[self._square] @ wanted + data.qfrc_bias[self._speeds]
        data.ctrl[self._controls] = np.minimum(np.maximum(torques, self._least), self._most)


def _actuators(model: Any, joints: Sequence[int]) -> list[int]:
    """Return the actuator of each joint."""
    targets = model.actuator_trnid[:, 0].tolist()
    return [targets.index(joint) for joint in joints]
