"""Follow an instruction with a policy that chooses between motions: turns, steps forward, stop."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from vlatool.controllers._discrete_policy import Observed, choose, observation, observed_by
from vlatool.controllers._freshness import CLOCK_STEP_S, age_s, note_changes, stamp_of
from vlatool.controllers._geometry import PlanarPose, pose_of, twist
from vlatool.controllers._interface import Command, Input, Output, Service, Snapshot
from vlatool.controllers._motions import BACKWARD, FORWARD, STOP, WAIT, Motion, Speeds, drive, motions_of, plan
from vlatool.controllers._sensor_arrays import colours_of, depth_of
from vlatool.controllers._settings import check_finite, check_range, check_rate
from vlatool.controllers._vln_state import (
    ARRIVED_PHASE,
    FAILED_PHASE,
    IDLE_PHASE,
    PAUSED_PHASE,
    RUNNING_PHASE,
    VlnState,
)
from vlatool.errors import DeadlineMissed, UsageError, VlatoolError
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.nav_msgs import Odometry
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import Bool, String

ALLOWED_SPEED = {"linear": 0.306, "angular": 1.9}
"""Fastest of a Create 3 with its safety on, in m/s and rad/s (Create 3 documentation, "Safety")."""
LARGEST = {
    "position_m": 1.0, "angle_deg": 45.0, "clearance_m": 10.0, "way_share": 1.0, "max_age_s": CLOCK_STEP_S,
    "motion_s": 600.0, "settle_s": 60.0,
}  # fmt: skip
"""Setting -> its largest value; the least is 0. With larger ones no motion would be checked."""
ASTRAY_M = 0.5
"""Distance that a step's end may be farther away than at its start, in metres: the odometry has jumped beyond it."""

RESTING_SPEED = {"linear": 0.02, "angular": 0.05}
"""Speeds in odometry up to which a robot stands, in m/s and rad/s: what an encoder or a gyroscope may say at rest."""


@dataclass(frozen=True)
class Vln:
    """Follows the instruction on ``/vln/instruction`` with the motions that a policy chooses.

    The policy sees a frame when the robot stands, and its action becomes a motion: a turn by ``turn_deg`` or a step of
    ``forward_m``, from the pose at which the last motion was to end, so that small errors do not add up. Odometry ends
    it. The next frame, and depth where there is one, were taken after that, and after odometry said that the robot
    stands; the first one after the instruction came. A step forward that depth says is blocked is not driven, and the
    policy is asked again, with the action among its past ones.

    It ends with a ``stop`` label or when ``/vln/arrived`` says so; where that is said again and again, the policy is
    asked once it was said after the frame came. It never moves without an instruction; an empty one ends it. It stands
    while the camera, the odometry or a depth camera that was there is older than ``max_age_s``. The first word of
    ``/vln/status`` is ``idle``, ``running``, ``paused``, ``arrived`` or ``failed``.

    Args:
        rate: Steps in a second.
        turn_deg: Angle of a turn, in degrees.
        forward_m: Length of a step, in metres.
        max_linear_speed: In m/s.
        max_angular_speed: In rad/s.
        position_m: Distance from its end at which a step ends, in metres.
        angle_deg: Angle from its end at which a turn ends, in degrees.
        clearance_m: Depth beyond a step that must be free, in metres.
        way_share: Share of the width of the depth image, in its middle, that is the way ahead.
        max_age_s: Age of the camera, odometry and depth above which the robot stands, in seconds.
        motion_s: Time after which a motion that did not reach its end is over, in seconds.
        settle_s: Time after a motion or an instruction after which a frame that comes is used whatever its stamp and
            the speed of odometry, in seconds.
        max_actions: Actions after which it gives up; 0 for none.
        motions: ``LABEL=MOTION`` for labels whose words do not say it, separated by commas.
        policy: What ``vlatool.load`` returned.

    Raises:
        UsageError: for a setting out of its range, or a policy without labels that are motions.
    """

    rate: float = 10.0
    turn_deg: float = 90.0
    forward_m: float = 1.0
    max_linear_speed: float = 0.3
    max_angular_speed: float = 1.0
    position_m: float = 0.01
    angle_deg: float = 1.0
    clearance_m: float = 0.25
    way_share: float = 0.3
    max_age_s: float = 0.5
    motion_s: float = 20.0
    settle_s: float = 1.0
    max_actions: int = 0
    motions: str = ""
    policy: Any = field(default=None, metadata={"setting": False})

    def __post_init__(self) -> None:
        check_finite(self)
        check_rate(self.rate)
        check_range("turn_deg", self.turn_deg, 1.0, 180.0)
        check_range("forward_m", self.forward_m, 0.01, 10.0)
        check_range("max_linear_speed", self.max_linear_speed, 0.01, ALLOWED_SPEED["linear"])
        check_range("max_angular_speed", self.max_angular_speed, 0.01, ALLOWED_SPEED["angular"])
        for name, high in LARGEST.items():
            check_range(name, getattr(self, name), 0.0, high)
        check_range("max_actions", self.max_actions, 0)
        if self.policy is not None:
            motions_of(self._observed.labels, self.motions)

    @cached_property
    def _observed(self) -> Observed:
        if self.policy is None:
            raise UsageError(
                "vln has no policy; allowed: one that vlatool.load returned.", "name a bundle: --bundle DIR"
            )
        return observed_by(self.policy.spec)

    @cached_property
    def _motions(self) -> tuple[str, ...]:
        return motions_of(self._observed.labels, self.motions)

    @property
    def rate_hz(self) -> float:
        """Steps in a second."""
        return self.rate

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Camera, odometry and instruction; depth and the word that it arrived where the robot has them."""
        return (
            Input("image", "/camera/color/image_raw", Image),
            Input("odometry", "/odom", Odometry),
            Input("instruction", "/vln/instruction", String, required=False, reliable=True, latched=True),
            Input("depth", "/camera/depth/image_raw", Image, required=False),
            Input("arrived", "/vln/arrived", Bool, required=False, reliable=True),
        )

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Velocity and status."""
        return (Output("cmd_vel", "/cmd_vel", Twist), Output("status", "/vln/status", String, latched=True))

    @property
    def services(self) -> tuple[Service, ...]:
        """Nothing."""
        return ()

    def start(self) -> VlnState:
        """Return the state of a robot without an instruction; the policy is reset.

        Raises:
            UsageError: without a policy, or with one whose labels are not motions.
        """
        _ = self._motions
        self.policy.reset()
        return VlnState()

    def step(self, snapshot: Snapshot, state: VlnState) -> tuple[Command, VlnState]:
        """Return the velocity and the status at this step."""
        state = self._listen(snapshot, state)
        changes = note_changes(snapshot, ("image", "odometry", "depth"), state.changes)
        state = state._replace(changes=changes)
        if state.phase in (IDLE_PHASE, ARRIVED_PHASE, FAILED_PHASE):
            return self._stand(state)
        pose = pose_of(snapshot.message("odometry", Odometry))
        trouble = self._trouble(snapshot, state, pose)
        if trouble or pose is None:
            return self._stand(state._replace(phase=PAUSED_PHASE, detail=trouble))
        state = state._replace(phase=RUNNING_PHASE)
        if state.has_arrived:
            return self._stand(state._replace(detail="looking"))
        if state.motion is not None:
            return self._move(snapshot, state, state.motion, pose)
        return self._decide(snapshot, state, pose)

    def rest(self) -> Command:
        """Stand."""
        return Command({"cmd_vel": (twist(),), "status": (String(IDLE_PHASE),)}, status="stopped")

    def _listen(self, snapshot: Snapshot, state: VlnState) -> VlnState:
        """Return the state after what came on the instruction and on the word that the robot arrived."""
        reading = snapshot.newest.get("instruction")
        if reading is not None and reading.sequence != state.heard:
            text = reading.message.data.strip() if isinstance(reading.message, String) else ""
            self.policy.reset()
            phase = RUNNING_PHASE if text else IDLE_PHASE
            heard = VlnState(phase=phase, instruction=text, heard=reading.sequence, changes=state.changes)
            return self._ended(snapshot, heard)
        if state.phase not in (RUNNING_PHASE, PAUSED_PHASE):
            return state
        if any(getattr(item.message, "data", False) for item in snapshot.readings.get("arrived", ())):
            state = state._replace(motion=None, has_arrived=True)
        if state.has_arrived and state.phase == RUNNING_PHASE:  # it runs again before it ends
            return state._replace(phase=ARRIVED_PHASE, detail="")
        return state

    def _trouble(self, snapshot: Snapshot, state: VlnState, pose: PlanarPose | None) -> str:
        """Return why the robot cannot move now; empty when it can."""
        for name, what in (("odometry", "odometry"), ("image", "camera"), ("depth", "depth")):
            age = age_s(snapshot, name, state.changes)
            if name == "depth" and name not in snapshot.newest:
                continue
            if not age <= self.max_age_s:
                return f"no {what} yet" if math.isinf(age) else f"{what} {age:.1f} s old"
        return "odometry is not a pose" if pose is None else ""

    def _move(self, snapshot: Snapshot, state: VlnState, motion: Motion, pose: PlanarPose) -> tuple[Command, VlnState]:
        """Go on with a motion, or end it."""
        speeds = Speeds(self.max_linear_speed, self.max_angular_speed, self.position_m, math.radians(self.angle_deg))
        linear, angular, over = drive(motion, pose, speeds)
        waypoint = motion.goal
        late = snapshot.time_s - motion.began_s > self.motion_s
        hit = motion.kind == FORWARD and self._ahead(snapshot) < self.clearance_m
        left_m = math.hypot(motion.goal.x - pose.x, motion.goal.y - pose.y)
        astray = motion.kind in (FORWARD, BACKWARD) and left_m > self.forward_m + ASTRAY_M
        if not over and (late or hit or astray):
            over, waypoint, linear, angular = True, pose, 0.0, 0.0
        if over:
            state = self._ended(snapshot, state._replace(motion=None, waypoint=waypoint))
            detail = "blocked on the way" if hit else "odometry jumped" if astray else "looking"
            return self._stand(state._replace(detail=detail))
        return self._command(state._replace(detail=motion.kind), linear, angular), state

    def _decide(self, snapshot: Snapshot, state: VlnState, pose: PlanarPose) -> tuple[Command, VlnState]:
        """Ask the policy, once there is a frame that was taken while the robot stood."""
        state = self._note_frame(snapshot, state)
        if not self._may_choose(snapshot, state):
            return self._stand(state._replace(detail="looking"))
        if self.max_actions and len(state.actions) >= self.max_actions:
            return self._stand(state._replace(phase=FAILED_PHASE, detail=f"no arrival in {self.max_actions} actions"))
        image, problem = colours_of(snapshot.message("image", Image))
        if image is None:
            return self._stand(state._replace(phase=PAUSED_PHASE, detail=problem))
        known = tuple(frame for frame in state.frames if frame.shape == image.shape)
        frames = (*known, image)[-self._observed.frames :]
        try:
            index = choose(self.policy, observation(self._observed, frames, state.actions, state.instruction))
            kind = self._motions[index]
        except DeadlineMissed:
            return self._stand(state._replace(detail="the policy is late"))
        except (VlatoolError, IndexError) as error:
            detail = error.message if isinstance(error, VlatoolError) else "the policy chose an action without a label"
            return self._stand(state._replace(phase=FAILED_PHASE, detail=detail))
        waypoint = state.waypoint or pose
        state = state._replace(frames=frames, actions=(*state.actions, index), waypoint=waypoint)
        return self._begin(snapshot, state, kind, waypoint)

    def _begin(self, snapshot: Snapshot, state: VlnState, kind: str, waypoint: PlanarPose) -> tuple[Command, VlnState]:
        """Begin the motion of an action at a pose; nothing is driven at this step."""
        over = self._ended(snapshot, state)
        if kind == STOP:
            return self._stand(state._replace(phase=ARRIVED_PHASE, detail="by its stop label"))
        if kind == WAIT:
            return self._stand(over._replace(detail=WAIT))
        if kind == FORWARD and self._ahead(snapshot) < self.forward_m + self.clearance_m:
            return self._stand(over._replace(detail="blocked"))
        motion = plan(kind, waypoint, math.radians(self.turn_deg), self.forward_m, snapshot.time_s)
        return self._stand(state._replace(motion=motion, detail=kind if kind != BACKWARD else "backward"))

    def _ended(self, snapshot: Snapshot, state: VlnState) -> VlnState:
        """Return the state in which a frame has to be later than now, and of a robot that stands."""
        odometry = snapshot.message("odometry", Odometry)
        stamp = odometry.header.stamp.seconds if odometry is not None else 0.0
        return _note_rest(
            snapshot, state._replace(ended_s=snapshot.time_s, ended_stamp=stamp, rest_stamp=None, frame_s=None)
        )

    def _note_frame(self, snapshot: Snapshot, state: VlnState) -> VlnState:
        """Note when the first frame, and depth where there is one, came that are of a robot that stands."""
        state, image = _note_rest(snapshot, state), snapshot.newest.get("image")
        if image is None or state.frame_s is not None:
            return state
        stamps = [
            stamp_of(snapshot.newest[name].message).seconds for name in ("image", "depth") if name in snapshot.newest
        ]
        rests = state.rest_stamp is not None and all(state.rest_stamp <= at > state.ended_stamp for at in stamps)
        late = image.received_s - state.ended_s >= self.settle_s
        return state._replace(frame_s=image.received_s) if rests or late else state

    def _may_choose(self, snapshot: Snapshot, state: VlnState) -> bool:
        """Whether there is such a frame and, where ``arrived`` comes again and again, a word of after it."""
        arrived = snapshot.newest.get("arrived")
        if state.frame_s is None or arrived is None:
            return state.frame_s is not None
        return arrived.received_s >= state.frame_s or snapshot.time_s - arrived.received_s > self.max_age_s

    def _ahead(self, snapshot: Snapshot) -> float:
        """Return the depth of the way ahead in metres: the 5th percentile of the middle; infinity where unknown."""
        depth, _ = depth_of(snapshot.message("depth", Image))
        if depth is None or not depth.size:
            return math.inf
        rows, columns = depth.shape
        half = max(round(columns * self.way_share / 2.0), 1)
        middle = depth[rows // 4 : max(rows // 2, rows // 4 + 1), max(columns // 2 - half, 0) : columns // 2 + half]
        known = middle[np.isfinite(middle)]
        return float(np.percentile(known, 5)) if known.size else math.inf

    def _stand(self, state: VlnState) -> tuple[Command, VlnState]:
        return self._command(state, 0.0, 0.0), state

    def _command(self, state: VlnState, linear: float, angular: float) -> Command:
        text = f"{state.phase} {state.detail}".strip()
        messages = {"cmd_vel": (twist(linear, angular),), "status": (String(text),)}
        return Command(messages, status=text, notes={"actions": float(len(state.actions))})


def _note_rest(snapshot: Snapshot, state: VlnState) -> VlnState:
    """Note the stamp of the first odometry since the last motion by which the robot stands."""
    odometry = snapshot.message("odometry", Odometry)
    if odometry is None or state.rest_stamp is not None:
        return state
    speeds = odometry.twist.twist
    moves = abs(speeds.linear.x) > RESTING_SPEED["linear"] or abs(speeds.angular.z) > RESTING_SPEED["angular"]
    return state if moves else state._replace(rest_stamp=odometry.header.stamp.seconds)
