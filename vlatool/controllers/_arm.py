"""The controller that all arms share: joint positions of a policy, within an envelope, from and to messages."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vlatool.controllers._arm_messages import OUTPUTS, command_messages
from vlatool.controllers._arm_policy import ArmPolicy, policy_of
from vlatool.controllers._arm_return import plan_return
from vlatool.controllers._arm_robot import ArmRobot, driver_names, finite, start_pose
from vlatool.controllers._arm_state import ACTING, HALT, RETURNING, WAITING, ArmState
from vlatool.controllers._arm_track import believe
from vlatool.controllers._freshness import CLOCK_STEP_S, age_s, note_changes
from vlatool.controllers._interface import Command, Input, Output, Service, Snapshot
from vlatool.controllers._settings import check_finite, check_range, check_rate
from vlatool.errors import BusError, DataError, UsageError, VlatoolError
from vlatool.messages import Message
from vlatool.messages.joints import joint_values
from vlatool.messages.sensor_msgs import JointState
from vlatool.messages.std_srvs import TriggerRequest, TriggerResponse
from vlatool.runtime.envelope import Envelope, KeepApart, Level, RobotLimits

Array = NDArray[Any]
ATTEMPTS = 3
"""Ways to the start pose that the envelope may end before it stays where it is."""
QUIET_S = 0.5
"""Time without a joint state after which an arm at rest is commanded no longer, in seconds."""
STOP_SHARE = 0.1
"""Margins of position by which a measured joint may be beyond its limit and still begin at it."""
SETTINGS = """Args:
    rate: Steps in a second.
    joint_names: Names of the joints in the messages of the driver, in the order above; those above when empty.
    output: ``trajectory`` for JointTrajectory, as drivers of ROS 2 take it, or ``joint_state`` for JointState.
    start_pose: Positions to which it returns, in the order above; those above when empty.
    return_at_start: Whether it goes to the start pose before the policy acts.
    speed: Share of the velocity limits that commands may use.
    acceleration: Share of the limits of acceleration and jerk that commands may use; all joints at once at their
        limits may ask for more than the motors can.
    margin_rad: By how much commands stay away from position limits, in rad.
    max_age_s: Age of the joint state above which the arm stops, in seconds.
    max_lag_rad: Distance of a joint from its command above which the arm stops, in rad.
    lead_s: Time after a command at which its positions are to be reached, in seconds; two periods when 0.
    clearance_m: Least distance between two arms, in metres.
    policy: What ``vlatool.load`` returned."""


@dataclass(frozen=True)
class ArmController:
    """Base of the controllers of arms; the class of a robot says which one, in ``ROBOT``.

    The positions of the joints go to the policy by their names; a joint that is missing or there twice stops the arm.
    Each command is one of an envelope of the robot, with a stop behind it. When the joint state is too old, or the
    policy has no action, the arm follows that stop, and goes on when both are there again. At start, and when
    ``~/return_to_start`` is called, it goes to its start pose; the answer of a call comes when it is there.
    """

    rate: float = 50.0
    joint_names: tuple[str, ...] = ()
    output: str = "trajectory"
    start_pose: tuple[float, ...] = ()
    return_at_start: bool = True
    speed: float = 0.5
    acceleration: float = 1.0
    margin_rad: float = 0.02
    max_age_s: float = 0.2
    max_lag_rad: float = 0.5
    lead_s: float = 0.0
    clearance_m: float = 0.09
    policy: Any = field(default=None, metadata={"setting": False})

    ROBOT: ClassVar[ArmRobot]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\n{SETTINGS}"

    def __post_init__(self) -> None:
        check_finite(self)
        check_rate(self.rate)
        if self.output not in OUTPUTS:
            raise UsageError.unknown(f"Unknown output '{self.output}'", self.output, OUTPUTS)
        check_range("speed", self.speed, 0.01, 1.0)
        check_range("acceleration", self.acceleration, 0.01, 1.0)
        check_range("margin_rad", self.margin_rad, 0.0, 0.5)
        check_range("lead_s", self.lead_s, 0.0, 1.0)
        check_range("clearance_m", self.clearance_m, 0.01, 1.0)
        check_range("max_age_s", self.max_age_s, 0.001, CLOCK_STEP_S)
        check_range("max_lag_rad", self.max_lag_rad, 0.001, math.pi)
        _ = self._names, self._start
        if self.policy is not None:
            _ = self._sees

    @cached_property
    def _limits(self) -> RobotLimits:
        return self.ROBOT.limits(self.speed, self.margin_rad, self.acceleration)

    @cached_property
    def _fastest(self) -> Array:
        """Largest speeds of the joints (A,) in units/s; infinite of those that have no limit."""
        joints = self.ROBOT.limits().joints
        speeds = [0.0 if joint.command == "range" else max(map(abs, joint.velocity)) for joint in joints]
        return np.array([speed or math.inf for speed in speeds])

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return driver_names(self.ROBOT, self.joint_names)

    @cached_property
    def _start(self) -> tuple[float, ...]:
        return start_pose(self.ROBOT, self.start_pose, self._limits)

    @cached_property
    def _longest_return_s(self) -> float:
        """Seconds from one end of all joints to the other, each attempt with a stop before it, and some to spare."""
        low, high = (tuple(joint.bounds[side] for joint in self._limits.joints) for side in (0, 1))
        return 2.0 * ATTEMPTS * plan_return(low, high, self._limits, 0.0).duration_s + 5.0

    @cached_property
    def _sees(self) -> ArmPolicy:
        if self.policy is None:
            raise UsageError(f"{self.ROBOT.name} has no policy; allowed: one that vlatool.load returned.",
                             "name a bundle: --bundle DIR")  # fmt: skip
        return policy_of(self.policy.spec, self.ROBOT)

    @property
    def limits_of(self) -> str:
        """The robot whose limits all commands keep; no further envelope is around the policy."""
        return self.ROBOT.name

    @property
    def rate_hz(self) -> float:
        """Steps in a second."""
        return self.rate

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The joint state, and what the policy sees: targets, cameras, an instruction."""
        joints = Input("joints", "/joint_states", JointState)
        return (joints, *(self._sees.inputs(self.ROBOT) if self.policy is not None else ()))

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Positions of the joints."""
        return (OUTPUTS[self.output],)

    @property
    def services(self) -> tuple[Service, ...]:
        """The way to the start pose."""
        return (
            Service("return_to_start", "~/return_to_start", TriggerRequest, TriggerResponse, self._longest_return_s),
        )

    def start(self) -> ArmState:
        """Return the state before the first joint state; the policy is reset.

        Raises:
            UsageError: without a policy, or with one whose inputs or action are not those of the robot.
        """
        _ = self._sees
        self.policy.reset()
        return ArmState()

    def step(self, snapshot: Snapshot, state: ArmState) -> tuple[Command, ArmState]:
        """Return the positions to command at this step."""
        state = state._replace(changes=note_changes(snapshot, ("joints",), state.changes))
        measured, problem, state = self._believe(snapshot, state, *self._measure(snapshot, state))
        if state.envelope is None:
            if measured is not None:
                state, problem = self._begin(measured, snapshot.time_s, state)
            if (envelope := state.envelope) is None:
                return self._wait(snapshot, state._replace(detail=problem))
        else:
            envelope = state.envelope.copy()
            state = state._replace(envelope=envelope)
        state = self._listen(snapshot, state)
        wanted, state = self._wanted(snapshot, state, envelope, measured, problem)
        return self._send(snapshot, state, state.envelope or envelope, wanted, measured)

    def rest(self) -> Command:
        """Send nothing: a joint that is commanded by position stays at its last command."""
        return Command(status="stopped")

    def _measure(self, snapshot: Snapshot, state: ArmState) -> tuple[Array | None, str]:
        """Return the positions of the joints (A,), or None and what is wrong."""
        message = snapshot.message("joints", JointState)
        if message is None:
            return None, "no joint state"
        age = age_s(snapshot, "joints", state.changes)
        if not age <= self.max_age_s:
            return None, f"joint state {age:.1f} s old"
        try:
            values = joint_values(message, self._names)
        except BusError as error:
            return None, error.message
        if not finite(values):
            broken = [name for name, value in zip(self._names, values, strict=True) if not np.isfinite(value)]
            return None, f"no number for the joint {broken[0]}"
        return values, ""

    def _believe(
        self, snapshot: Snapshot, state: ArmState, measured: Array | None, problem: str
    ) -> tuple[Array | None, str, ArmState]:
        """Return positions that the arm can have, or None and what is wrong, and the state with them."""
        if measured is None:
            return None, problem, state
        reading = snapshot.newest["joints"]
        track, jumped = believe(state.track, measured, reading.received_s, reading.sequence, self._fastest)
        state = state._replace(track=track)
        if jumped >= 0:
            away = abs(measured[jumped] - track.values[jumped])
            unit = self._limits.joints[jumped].unit
            return None, f"{self._names[jumped]} jumped by {away:.2f} {unit}", state
        return (measured, "", state) if track.has_begun else (None, "joint states that agree", state)

    def _begin(self, measured: Array, now_s: float, state: ArmState) -> tuple[ArmState, str]:
        """Begin at rest where the robot is."""
        envelope = Envelope(self._limits, 1.0 / self.rate, apart=self._apart())
        try:
            envelope.start(self._inside(measured))
        except DataError as error:
            return state, error.message
        phase = RETURNING if self.return_at_start else ACTING
        return state._replace(envelope=envelope, phase=phase, way=None, attempts=0, last_s=now_s - 1.0 / self.rate), ""

    def _inside(self, measured: Array) -> list[float]:
        """Return measured positions, those between a limit and its margin, or just outside, moved to the margin."""
        room = (1.0 + STOP_SHARE) * self.margin_rad + 1e-3
        values = []
        for joint, value in zip(self._limits.joints, measured.tolist(), strict=True):
            low, high = joint.bounds
            allowed = 0.1 * (high - low) if joint.command == "range" else room
            near = low - allowed <= value <= high + allowed
            values.append(min(max(value, low), high) if near else value)
        return values

    def _apart(self) -> KeepApart | None:
        """Return what keeps two arms apart; None for a robot of one."""
        return None

    def _wait(self, snapshot: Snapshot, state: ArmState) -> tuple[Command, ArmState]:
        """Do nothing before the first joint state; calls are refused."""
        text = f"{WAITING}: {state.detail}"
        answers: dict[int, Message] = {call.number: TriggerResponse(False, text) for call in snapshot.requests}
        return Command(responses=answers, status=text), state

    def _listen(self, snapshot: Snapshot, state: ArmState) -> ArmState:
        """Return the state after calls of the service."""
        calls = tuple(call.number for call in snapshot.requests)
        if not calls:
            return state
        if state.phase == RETURNING:
            return state._replace(calls=(*state.calls, *calls))
        return state._replace(phase=RETURNING, way=None, attempts=0, calls=(*state.calls, *calls))

    def _wanted(
        self, snapshot: Snapshot, state: ArmState, envelope: Envelope, measured: Array | None, problem: str
    ) -> tuple[list[float] | None, ArmState]:
        """Return the positions that are wanted, in the order of the robot, or None for the next step of the stop."""
        if measured is None:
            since_s = snapshot.time_s if state.silent_since_s is None else state.silent_since_s
            return None, state._replace(way=None, detail=problem, silent_since_s=since_s)
        resumes = state.silent_since_s is not None and envelope.at_rest()
        late = self._lagging(envelope, measured, resumes)
        if late:
            at_rest = envelope.at_rest()
            state = self._begin_again(state, measured, late) if at_rest else state._replace(detail=late)
            return None, state._replace(way=None)
        state = state._replace(silent_since_s=None)
        if state.phase == RETURNING:
            return self._return(snapshot, state, envelope)
        if state.phase == HALT:
            return None, state
        return self._act(snapshot, state, envelope, measured)

    def _lagging(self, envelope: Envelope, measured: Array, resumes: bool) -> str:
        """Return which joint is far from its command; empty if none is.

        Args:
            resumes: Whether there were no joint states until now, and the arm stands: a command from which a joint is
                farther than it goes in the time of a command would then let it leap.
        """
        for joint, name, value, commanded in zip(
            self._limits.joints, self._names, measured.tolist(), envelope.position, strict=True
        ):
            if joint.command == "range":
                continue
            most = min(self.max_lag_rad, joint.velocity[1] * self._lead_s) if resumes else self.max_lag_rad
            if abs(value - commanded) > most:
                return f"{name} is {abs(value - commanded):.2f} {joint.unit} from its command"
        return ""

    def _begin_again(self, state: ArmState, measured: Array, why: str) -> ArmState:
        """Command what is measured: an arm that something else moved stays where it is, unless it is out of limits."""
        again, problem = self._begin(measured, state.last_s + 1.0 / self.rate, state)
        if again.envelope is state.envelope:
            return state._replace(detail=problem)
        return again._replace(phase=state.phase, attempts=state.attempts, silent_since_s=None, detail=why)

    def _return(self, snapshot: Snapshot, state: ArmState, envelope: Envelope) -> tuple[list[float] | None, ArmState]:
        way, now = state.way, snapshot.time_s
        if way is None:
            if not envelope.at_rest():
                return None, state._replace(detail="stopping first")
            way = plan_return(envelope.position, self._start, self._limits, now)
        if way.is_over(now) and envelope.position == self._start and envelope.at_rest():
            self.policy.reset()
            return list(self._start), state._replace(phase=ACTING, way=None, attempts=0, detail="at the start pose")
        return way.at(now), state._replace(way=way, detail="to the start pose")

    def _act(
        self, snapshot: Snapshot, state: ArmState, envelope: Envelope, measured: Array
    ) -> tuple[list[float] | None, ArmState]:
        seen, missing = self._sees.observation(snapshot, self.ROBOT, measured)
        if seen is None:
            return None, state._replace(detail=missing)
        try:
            action = self.policy.act(seen)
        except VlatoolError as error:
            return None, state._replace(detail=error.message)
        wanted = self._sees.positions(action, envelope.position, 1.0 / self.rate)
        return wanted, state._replace(detail="" if wanted is not None else "an action of another shape")

    def _send(
        self,
        snapshot: Snapshot,
        state: ArmState,
        envelope: Envelope,
        wanted: list[float] | None,
        measured: Array | None,
    ) -> tuple[Command, ArmState]:
        """Let the envelope answer, and put its positions into messages."""
        quiet = self._is_quiet(snapshot, state, envelope)
        result = envelope.step(wanted, elapsed_s=snapshot.time_s - state.last_s)
        state = state._replace(last_s=snapshot.time_s)
        if state.way is not None and wanted is not None and result.level >= Level.CRITICAL:
            attempts = state.attempts + 1
            phase, detail = (RETURNING, "stopped on the way") if attempts < ATTEMPTS else (HALT, "the way is not free")
            state = state._replace(phase=phase, way=None, attempts=attempts, detail=detail)
        answers, state = self._answers(state)
        checks = ",".join(result.checks)
        status = ": ".join(part for part in (state.phase, state.detail or checks) if part)
        messages = (
            {} if quiet
            else command_messages(self.output, self._names, envelope.position, snapshot.stamp, self._lead_s)
        )  # fmt: skip
        notes = self._notes(envelope, measured, checks)
        return Command(messages, answers, status, notes), state

    def _is_quiet(self, snapshot: Snapshot, state: ArmState, envelope: Envelope) -> bool:
        """Return whether nothing is sent: a robot that starts again elsewhere must not find a command of before."""
        since_s = state.silent_since_s
        return since_s is not None and snapshot.time_s - since_s > QUIET_S and envelope.at_rest()

    @property
    def _lead_s(self) -> float:
        return self.lead_s or 2.0 / self.rate

    def _answers(self, state: ArmState) -> tuple[Mapping[int, Message], ArmState]:
        """Answer the calls that wait, once the arm is at its start pose or will not get there."""
        if state.phase == RETURNING or not state.calls:
            return {}, state
        answer = TriggerResponse(state.phase == ACTING, state.detail)
        return dict.fromkeys(state.calls, answer), state._replace(calls=())

    def _notes(self, envelope: Envelope, measured: Array | None, checks: str) -> dict[str, float | str]:
        notes: dict[str, float | str] = {"checks": checks} if checks else {}
        if measured is not None:
            arms = [joint.command != "range" for joint in self._limits.joints]
            notes["lag_rad"] = float(np.abs(measured - np.array(envelope.position))[arms].max())
        return notes
