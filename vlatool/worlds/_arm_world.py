"""The world that all simulated arms share: joints that report themselves and go where a command says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import BusError, UsageError
from vlatool.messages import Message
from vlatool.messages.joints import joint_values
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_msgs import Header
from vlatool.messages.trajectory_msgs import JointTrajectory
from vlatool.worlds._arm_distance import ArmDistance
from vlatool.worlds._arm_model import ModelFile, compile_model
from vlatool.worlds._arm_servos import PositionServos, Setpoint, TorqueServos
from vlatool.worlds._faults import Outbox, read_knob, time_of
from vlatool.worlds._interface import Channel
from vlatool.worlds._simulation import advance_model, load_mujoco

Array = NDArray[Any]
SENSORS = {"joints": Channel("/joint_states", JointState)}
TRAJECTORY = Channel("/joint_trajectory_controller/joint_trajectory", JointTrajectory)
COMMAND = Channel("/joint_commands", JointState)
KNOBS = ("delay", "drop", "freeze", "noise")


class Tip(NamedTuple):
    """A place on a body of the model: the body, and metres in its frame."""

    body: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Mirror(NamedTuple):
    """A joint of the model that goes where another one goes, times a factor: the second finger of a gripper."""

    joint: str
    of: str
    factor: float


class ArmSetup(NamedTuple):
    """What a world says of its model.

    Args:
        file: The model.
        joints: Joint as the driver names it -> joint of the model.
        start: Positions at the reset.
        tips: Arm -> its tip; the name is empty where there is one.
        servos: Kind of the model's actuators.
        mirrors: Joints that follow others.
        arms: Roots of two arms, bodies of the model, whose distance is watched.
    """

    file: ModelFile
    joints: Mapping[str, str]
    start: tuple[float, ...]
    tips: Mapping[str, Tip]
    servos: type[PositionServos] | type[TorqueServos]
    mirrors: tuple[Mirror, ...] = ()
    arms: tuple[str, str] | None = None


KNOB_TEXT = """Args:
    rate: How often the joints report themselves, in Hz.
    spread: Greatest distance of each joint from its start pose at the reset, in rad; grippers are at theirs.
    delay: Seconds until a joint state arrives.
    drop: Share of joint states that are lost.
    freeze: Share of joint states after which the content of that one is sent again for half a second.
    noise: Standard deviation of positions, in rad or m.
    contacts: Whether bodies touch each other; without, commands and servos alone move the joints.
    models: Folder with unpacked packages, in which the model is; what is installed when empty."""


@dataclass
class ArmWorld:
    """Base of the worlds of arms; the class of a robot says which one, in ``SETUP``."""

    rate: float = 100.0
    spread: float = 0.1
    delay: str = ""
    drop: str = ""
    freeze: str = ""
    noise: str = ""
    contacts: bool = True
    models: str = ""
    _knobs: dict[str, dict[str, float]] = field(default_factory=dict, init=False, repr=False)

    SETUP: ClassVar[ArmSetup]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__doc__ = f"{(cls.__doc__ or '').strip()}\n\n{KNOB_TEXT}"

    def __post_init__(self) -> None:
        for name in KNOBS:
            self._knobs[name] = read_knob(name, getattr(self, name), SENSORS)
        if not 1.0 <= self.rate <= 500.0:
            raise UsageError(f"rate is {self.rate!r}; allowed: 1 to 500 Hz.", "change rate, for example to 100")
        if not 0.0 <= self.spread <= 1.0:
            raise UsageError(f"spread is {self.spread!r}; allowed: 0 to 1 rad.", "change spread")
        self._mujoco = load_mujoco()
        self._model = compile_model(self.SETUP.file.find(self.models), self.contacts)
        self._step_s = float(self._model.opt.timestep)
        self._names = tuple(self.SETUP.joints)
        self._joints = [self._joint(name) for name in self.SETUP.joints.values()]
        self._mirrors = [(self._joint(m.joint), self._names.index(m.of), m.factor) for m in self.SETUP.mirrors]
        every = [*self._joints, *(joint for joint, _, _ in self._mirrors)]
        self._servos = self.SETUP.servos(self._mujoco, self._model, every)
        self._distance = ArmDistance(self._mujoco, self._model, *self.SETUP.arms) if self.SETUP.arms else None
        self._places, self._speeds = self._model.jnt_qposadr[self._joints], self._model.jnt_dofadr[self._joints]
        self.reset(0)

    def _joint(self, name: str) -> int:
        return int(self._mujoco.mj_name2id(self._model, self._mujoco.mjtObj.mjOBJ_JOINT, name))

    @property
    def sensors(self) -> tuple[Channel, ...]:
        """The joint state."""
        return (SENSORS["joints"]._replace(rate_hz=self.rate),)

    @property
    def commands(self) -> tuple[Channel, ...]:
        """A trajectory, as drivers of ROS 2 take it, or a state that is wanted."""
        return (TRAJECTORY, COMMAND)

    @property
    def time_s(self) -> float:
        """Simulated time since the reset, in seconds."""
        return self._ticks * self._step_s

    def reset(self, seed: int) -> None:
        """Start again, near the start pose, at rest; where each joint is, and the noise, are of this seed."""
        random = np.random.default_rng(seed)
        self._random = np.random.default_rng([seed, 1])
        self._data = self._mujoco.MjData(self._model)
        if self._model.nkey:
            self._mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        hinges = self._model.jnt_type[self._joints] == self._mujoco.mjtJoint.mjJNT_HINGE
        positions = np.array(self.SETUP.start) + hinges * random.uniform(-self.spread, self.spread, len(self._names))
        self._data.qpos[self._places] = positions
        for joint, of, factor in self._mirrors:
            self._data.qpos[self._model.jnt_qposadr[joint]] = factor * positions[of]
        self._setpoint = Setpoint(positions)
        self._wanted = np.zeros((2, len(positions) + len(self._mirrors)))
        faults = (self._knobs["delay"], self._knobs["drop"], self._knobs["freeze"], np.random.default_rng([seed, 2]))
        self._outbox, self._ticks, self._sent, self._refused = Outbox(*faults), 0, 0, ""
        self._mujoco.mj_forward(self._model, self._data)
        self._lowest, self._highest = positions.copy(), positions.copy()
        self._fastest = np.zeros(len(positions))
        self._measured = (-1, float("inf"))
        self._least = self._distance_now()

    def advance(self, seconds: float) -> None:
        """Simulate this much time, in steps of the model."""
        end = self._ticks + round(seconds / self._step_s)
        while self._ticks < end:
            self._tick()
            if self.time_s * self.rate >= self._sent + 1 - 1e-9:
                self._sent += 1
                self._report()

    def _tick(self) -> None:
        data, count = self._data, len(self._names)
        positions, velocities = self._setpoint.at(self.time_s)
        if self._mirrors:
            wanted, speeds = self._wanted
            wanted[:count], speeds[:count] = positions, velocities
            for index, (_, of, factor) in enumerate(self._mirrors, count):
                wanted[index], speeds[index] = factor * positions[of], factor * velocities[of]
            positions, velocities = wanted, speeds
        self._servos.control(data, positions, velocities)
        advance_model(self._mujoco, self._model, data)
        self._ticks += 1
        reached = data.qpos[self._places]
        np.minimum(self._lowest, reached, out=self._lowest)
        np.maximum(self._highest, reached, out=self._highest)
        np.maximum(self._fastest, np.abs(data.qvel[self._speeds]), out=self._fastest)

    def _report(self) -> None:
        data = self._data
        self._least = min(self._least, self._distance_now())
        noise = self._knobs["noise"].get("joints", 0.0)
        positions = data.qpos[self._places] + (noise * self._random.standard_normal(len(self._names)) if noise else 0.0)
        message = JointState(
            Header(time_of(self.time_s)), self._names, positions, data.qvel[self._speeds].copy(),
            data.qfrc_actuator[self._speeds].copy(),
        )  # fmt: skip
        self._outbox.put("joints", SENSORS["joints"].topic, message, self.time_s)

    def _distance_now(self) -> float:
        """Return the distance of two arms in metres, infinity for one; it is computed once in a step."""
        if self._distance is None:
            return float("inf")
        if self._measured[0] != self._ticks:
            self._measured = self._ticks, self._distance.measure(self._data)
        return self._measured[1]

    def reports(self) -> list[tuple[str, Message]]:
        """Return the joint states that arrived since the last call, in order."""
        return self._outbox.take(self.time_s)

    def obey(self, topic: str, message: Message) -> None:
        """Go where a command says: to the last point of a trajectory, in its time, or at once.

        A command for other joints, or with a position that is not a number, is refused, as the driver does;
        ``truth()["refused"]`` says why.

        Raises:
            UsageError: for another topic or message.
        """
        known = {channel.topic: channel.message for channel in self.commands}
        if type(message) is not known.get(topic):
            raise UsageError(
                f"This robot does not obey {type(message).__name__} on {topic}; allowed: JointTrajectory on "
                f"{TRAJECTORY.topic}, JointState on {COMMAND.topic}.",
                "map the topic of the controller",
            )
        self._refused, seconds = "", 0.0
        if isinstance(message, JointTrajectory):
            if not message.points:
                self._refused = "a trajectory without points"
                return
            point = message.points[-1]
            seconds, message = (
                point.time_from_start.seconds,
                JointState(message.header, message.joint_names, point.positions),
            )
        try:
            positions = joint_values(message, self._names)  # type: ignore[arg-type]  # one of two classes
        except BusError as error:
            self._refused = error.message
            return
        if not np.isfinite(positions).all() or not 0.0 <= seconds < 3600.0:
            self._refused = "a position or a time that is not a number"
            return
        self._setpoint.aim(positions, self.time_s, seconds)

    def truth(self) -> Mapping[str, Any]:
        """Return ``positions`` and ``velocities`` (A,), ``tips``, ``lowest``, ``highest``, ``fastest``, ``refused``.

        ``tips`` are places in the world (3,) in metres. The extremes are those of all steps since the reset, in rad or
        m, and per second. A robot of two arms has ``distance_m`` and ``least_distance_m`` between their geometries.
        """
        data = self._data
        values: dict[str, Any] = {
            "positions": data.qpos[self._places].copy(), "velocities": data.qvel[self._speeds].copy(),
            "tips": {name: self._tip(tip) for name, tip in self.SETUP.tips.items()},
            "lowest": self._lowest.copy(), "highest": self._highest.copy(), "fastest": self._fastest.copy(),
            "refused": self._refused,
        }  # fmt: skip
        if self._distance is not None:
            values["distance_m"] = self._distance_now()
            values["least_distance_m"] = min(self._least, values["distance_m"])
        return values

    def _tip(self, tip: Tip) -> Array:
        body = self._data.body(tip.body)
        position: Array = body.xpos + body.xmat.reshape(3, 3) @ np.array(tip.offset)
        return position
