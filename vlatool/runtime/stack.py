"""The layers between a policy and a robot, built in the one order that makes sense.

From the inside: wrappers of the policy, the check of what they give, the deadline, the player of chunks, the fallback
ladder, wrappers of the controller, the envelope. ``Stack`` is the controller around all of them, which measures each
control step and gives a record of it to a sink.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import UsageError
from vlatool.files.validate import short_repr
from vlatool.machine.version import VERSION
from vlatool.runtime.action_elements import rotations_of
from vlatool.runtime.arguments import check_positive
from vlatool.runtime.control import build_layer, check_order, layers, options_of
from vlatool.runtime.control.action_check import CheckedPolicy
from vlatool.runtime.control.chunked import ChunkQueue
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.control.dual_rate import DualRate
from vlatool.runtime.control.fallback import HOLD_S, FallbackLadder
from vlatool.runtime.interface import FALLBACK, STOP, Array, Controller, Origin, Policy, layers_of, origin_of
from vlatool.runtime.policy import BundlePolicy
from vlatool.runtime.rungs import ChunkRung, Hold, PolicyRung, Rung, Stop, start_pose
from vlatool.runtime.telemetry.cadence import Stopwatch
from vlatool.runtime.telemetry.record import Delivery, Sink, TickRecord
from vlatool.runtime.telemetry.recorder import Recorder, refuse_background
from vlatool.runtime.telemetry.replay import Replay
from vlatool.runtime.telemetry.run_file import OF_A_FUNCTION, RunHeader
from vlatool.runtime.telemetry.writer import Telemetry

__all__ = ["Fallback", "Sink", "Stack", "TickRecord", "Wrapper", "build_stack", "prepare_process"]
SWITCH_S = 0.0005
"""Longest that one Python thread may keep another from running, where there is a deadline: Python's own 5 ms would be
added to the answer when an inference is in Python code at its deadline (``sys.setswitchinterval``)."""
Wrapper = Callable[[Controller], Controller]


@dataclass(frozen=True)
class Fallback:
    """What acts where the policy has no action in time.

    Args:
        policy: A second policy, such as a smaller bundle or a client of another machine; none when None.
        policy_ms: Part of the deadline that is kept for it, in milliseconds; half of the deadline when None.
        max_age_ms: Age above which the rest of a chunk is not used, in milliseconds.
        hold_s: How long the robot holds or slows down before it counts as stopped, in seconds.
        ramp_s: Time in which a velocity falls to 0, in seconds.
        misses: Control steps without an action, of the last ``window``, until the ladder stays on a lower rung.
        window: See ``misses``.
        recover: Control steps in a row with an action until the policy has the robot again.
        latch: Whether a stopped robot waits for ``reset``.
        start: Pose that is held before the first action, (A,), where an action is a position.
        neutral: Label of the discrete action without motion.

    Raises:
        UsageError: when a number is out of its range, or the policy is none.
    """

    policy: Policy | None = None
    policy_ms: float | None = None
    max_age_ms: float | None = None
    hold_s: float = HOLD_S
    ramp_s: float = 0.5
    misses: int = 3
    window: int = 10
    recover: int = 5
    latch: bool = False
    start: Any = None
    neutral: str = ""

    def __post_init__(self) -> None:
        for name in ("policy_ms", "max_age_ms"):
            check_positive(name, getattr(self, name), "a number of milliseconds", optional=True)
        for name in ("hold_s", "ramp_s"):
            check_positive(name, getattr(self, name), "a number of seconds", zero=True)
        if not isinstance(self.latch, bool):
            raise UsageError(f"latch is {self.latch!r}; allowed: True or False.", "pass latch=True or latch=False")
        if self.policy is not None and not isinstance(self.policy, Policy):
            raise UsageError(
                f"The fallback is {self.policy!r}; allowed: a policy, or a Fallback.",
                "pass the directory of a bundle to load(), another policy, or Fallback(...)",
            )
        if self.policy is None and self.policy_ms is not None:
            raise UsageError("policy_ms is for a second policy, and there is none.", "pass Fallback(policy=...), too")


class Stack:
    """A controller of several layers.

    Args:
        controller: The outermost layer.
        telemetry: What gets the record of each control step, in a thread of its own (``Telemetry``): a function of it,
            or a ``Telemetry`` with several.
        recorder: What records each control step, or replays it.
        clock: Returns seconds.

    Raises:
        UsageError: when the sink cannot be called.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        telemetry: Sink | Telemetry | None = None,
        recorder: Recorder | Replay | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.telemetry = telemetry if telemetry is None or isinstance(telemetry, Telemetry) else Telemetry(telemetry)
        """What gets the records; None without telemetry."""
        self.recorder = recorder
        """What records the control steps; None where nothing does."""
        self.controller = controller
        self.layers = layers_of(controller)
        self.policy = self.layers[-1]
        self.spec: PolicySpec = self.policy.spec
        self.ladder = next((layer for layer in self.layers if isinstance(layer, FallbackLadder)), None)
        self.deadlines = [layer for layer in self._all() if isinstance(layer, Deadline)]
        self._alarms = [layer for layer in self.layers if hasattr(layer, "alarms")]
        beside = any(getattr(layer, "background", False) for layer in self.layers)
        self._stopwatch = Stopwatch(self._chains(), beside=beside)
        self._clock, self._step, self._answered = clock, 0, 0.0
        self._stop = (
            None
            if self.ladder is None
            else next(
                (layer.stop for layer in self.layers[: self.layers.index(self.ladder)] if hasattr(layer, "stop")), None
            )
        )
        self._stopped = False

    def _chains(self) -> list[list[Any]]:
        """Return the layers of each policy."""
        below = [] if self.ladder is None else self.ladder.rungs[1:]
        return [self.layers, *(layers_of(rung.controller) for rung in below if isinstance(rung, PolicyRung))]

    def _all(self) -> list[Any]:
        """Return the layers, those of a second policy after them."""
        return [layer for chain in self._chains() for layer in chain]

    @property
    def failed_records(self) -> int:
        """Records that sinks did not take."""
        return 0 if self.telemetry is None else self.telemetry.failure_count

    @property
    def fresh(self) -> bool:
        """Whether the last action was the first of a chunk."""
        return self.controller.fresh

    @property
    def origin(self) -> Origin:
        """Where the last action came from."""
        origin = origin_of(self.controller)
        return origin._replace(source=STOP) if self._stopped else origin

    def act(
        self, observation: Mapping[str, Any], *, scheduled: float | None = None, sensed: float | None = None
    ) -> Array:
        """Return the action of this control step: (A,) float32, or a 0-d int64 index of a discrete action.

        Args:
            observation: As ``infer`` takes it.
            scheduled: Time of the clock at which the step was to begin, from which the deadline counts; now when None.
            sensed: Time of the clock at which the (oldest) value of the observation was measured, for telemetry.

        Raises:
            Exception: what the policy raised, where no layer has an action.
        """
        called = self._clock() if scheduled is None or self.telemetry is not None else scheduled
        started = called if scheduled is None else scheduled
        for deadline in self.deadlines:
            deadline.started = started
        if self.telemetry is None and self.recorder is None:
            return self._act(observation)
        if self.telemetry is not None:
            self._stopwatch.begin()
        if self.recorder is not None:
            self.recorder.begin(observation)
        action, error = None, ""
        try:
            action = self._act(observation)
            return action
        except Exception as caught:
            error = f"{type(caught).__name__}: {caught}"
            raise
        finally:
            if self.recorder is not None:
                self.recorder.end(action, error)
            if self.telemetry is not None:
                self._record(started, called, sensed, action, error)

    def note_delivery(self) -> None:
        """Say that the last action has reached the robot, for telemetry."""
        if self.telemetry is not None:
            self.telemetry.put(Delivery(self._step - 1, (self._clock() - self._answered) * 1e3))

    def _act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of the controller, or the next of the envelope's proven stop where it has none."""
        self._stopped = False
        try:
            return self.controller.act(observation)
        except Exception as error:
            if self._stop is None:
                raise
            self._stopped = True
            try:
                return np.asarray(self._stop())
            except UsageError:  # the envelope does not know yet where the robot is
                raise error from None

    def _record(self, started: float, called: float, sensed: float | None, action: Array | None, error: str) -> None:
        rung, level, cause = 0, 0, error
        if self.ladder is not None:
            rung, level = self.ladder.rung, self.ladder.level
            cause = cause or ("" if self.ladder.error is None else str(self.ladder.error))
        self._answered = now = self._clock()
        waited_ms, answer_ms = (called - started) * 1e3, (now - started) * 1e3
        origin = self.origin if action is not None else Origin("")
        copied = None if action is None else np.array(action)  # what a sink does to it must not reach the robot
        self.telemetry.put(  # type: ignore[union-attr]
            TickRecord(
                self._step, started, waited_ms, answer_ms, bool(cause), rung, level, origin, cause, copied,
                None if sensed is None else (started - sensed) * 1e3, self._stopwatch.parts_ms(answer_ms - waited_ms),
                tuple(name for layer in self._alarms for name in layer.alarms),
            )
        )  # fmt: skip
        self._step += 1

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode of every layer; see ``Controller.reset``."""
        if isinstance(self.recorder, Recorder):
            self.recorder.call("reset", lambda: self.controller.reset(seed), [seed], {})
        else:
            self.controller.reset(seed)

    def close(self) -> None:
        """End the threads of the deadlines, of a slow part and of the telemetry, which writes what is left."""
        for layer in self._all():
            if isinstance(layer, Deadline | DualRate):
                layer.close()
        if self.telemetry is not None:
            self.telemetry.close()
        if self.recorder is not None:
            self.recorder.close()


def build_stack(
    policy: Policy,
    *,
    controllers: Sequence[str] = (),
    envelope: str | Wrapper | None = None,
    deadline_ms: float | None = None,
    fallback: Fallback | Policy | None = None,
    telemetry: Sink | Telemetry | None = None,
    recorder: Recorder | Replay | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Stack:
    """Return the layers around a policy.

    Args:
        controllers: Names of entries of the kind ``control``: what plays the policy, and wrappers.
        envelope: Robot whose limits no action leaves, by name; or a controller wrapper, called with the controller.
        deadline_ms: Time until ``act`` returns, in milliseconds, whatever the engine does: a late inference is stopped
            and never used, and a fallback answers. ``load`` also calls ``prepare_process``.
        fallback: What acts without an action in time, beside the rest of the last chunk, a hold and a stop: another
            policy, or a ``Fallback``.
        telemetry: Gets a ``TickRecord`` of each control step, off its path: a function, or ``Telemetry(...)``.
        recorder: Records each control step, so that a replay computes the same.
        clock: Returns seconds.

    Raises:
        UsageError: when a value or a name is not allowed, or the layers make no sense together.
        SpecError: when the rate of the spec is unknown, and something needs it.
    """
    _check_layers(controllers, envelope, telemetry)
    controllers = with_slow_part(policy, controllers)
    options = fallback if isinstance(fallback, Fallback) else Fallback(fallback)
    entries, chosen = layers(controllers), options_of(controllers)
    waits, factor = not any(given.get("background") for given in chosen.values()), rate_factor(controllers)
    limits_ms = [deadline_ms, _named_deadline(policy.spec, chosen[Deadline]) if Deadline in chosen else None]
    for limit_ms in limits_ms:
        check_deadline(policy.spec, limit_ms, waits=waits, factor=factor)
    own_ms = policy_ms(deadline_ms, options) if options.policy is not None else 0.0
    falls_back = deadline_ms is not None or fallback is not None
    wrappers = [entry for entry in entries if not hasattr(entry, "act")]
    player, *outer = entries[len(wrappers) :]
    check_order([*wrappers, *[Deadline] * (deadline_ms is not None), player, *[FallbackLadder] * falls_back, *outer])
    inner: Any = policy
    reader = clock if recorder is None else recorder.follow(clock)
    for entry in wrappers:
        inner = build_layer(entry, inner, spec=policy.spec, options=chosen.get(entry), clock=clock)
    limited = _limited(inner, None if deadline_ms is None else deadline_ms - own_ms, clock, recorder)
    inner = build_layer(player, limited, spec=policy.spec, options=chosen.get(player), clock=reader)
    ladder = _ladder(inner, policy.spec, options, deadline_ms, clock, recorder) if falls_back else None
    inner = ladder or inner
    for entry in outer:
        inner = build_layer(entry, inner, spec=policy.spec, options=chosen.get(entry), clock=reader)
    if envelope is not None:
        inner = _enveloped(inner, policy.spec, envelope, factor, clock)
        if ladder is not None and hasattr(inner, "stop"):
            for rung in ladder.rungs:
                if isinstance(rung, Hold):
                    rung.leave_to_envelope()
    if recorder is not None:
        _record_layers(recorder, layers_of(inner))
    return Stack(inner, telemetry=telemetry, recorder=recorder, clock=clock)


def with_slow_part(policy: Policy, controllers: Sequence[str]) -> list[str]:
    """Return controllers with a thread for the slow part of a policy of two systems, where none says how it runs."""
    named = [name.partition(":")[0] for name in controllers]
    if not isinstance(policy, BundlePolicy) or policy.slow is None or "dual_rate" in named:
        return list(controllers)
    return ["dual_rate:thread=true", *controllers]


def header_of(
    policy: BundlePolicy, given: Mapping[str, Any], *, threads: int | None, seed: int, second: str = ""
) -> RunHeader:
    """Return what a recorded run is of.

    Args:
        given: The arguments of ``build_stack``.
        threads, seed: With which the policy was opened.
        second: Identity of the bundle that the fallback was opened from; empty where it was opened elsewhere.
    """
    fallback, envelope = given["fallback"], given["envelope"]
    options = fallback if fallback is None or isinstance(fallback, Fallback) else Fallback(fallback)
    values = None
    if options is not None:
        values = {field.name: getattr(options, field.name) for field in fields(Fallback) if field.name != "policy"}
        values["start"] = None if options.start is None else np.asarray(options.start).tolist()
        second = second or ("" if options.policy is None else OF_A_FUNCTION)
    robot = envelope if isinstance(envelope, str) else "" if envelope is None else OF_A_FUNCTION
    return RunHeader(policy.identity, policy.engine, threads, seed, tuple(given["controllers"]), robot,
                     given["deadline_ms"], values, second, VERSION)  # fmt: skip


def _record_layers(recorder: Recorder | Replay, inside: Sequence[Any]) -> None:
    """Let a recorder see what changes the layers from outside."""
    refuse_background(inside)
    for layer in inside:
        if hasattr(layer, "envelope"):
            recorder.wrap_envelope(layer.envelope)


def _named_deadline(spec: PolicySpec, options: Mapping[str, Any]) -> float:
    """Return the deadline of the layer that ``controllers`` name, in milliseconds."""
    return options.get("deadline_ms") or 1000 / spec.rate


def _enveloped(
    controller: Controller, spec: PolicySpec, envelope: str | Wrapper, factor: int, clock: Callable[[], float]
) -> Any:
    """Return a controller with the envelope of a robot, or a wrapper, around it."""
    wrapper = robot_envelope(spec, envelope, factor, clock) if isinstance(envelope, str) else envelope
    wrapped = wrapper(controller) if callable(wrapper) else None
    if not isinstance(wrapped, Controller) or controller not in layers_of(wrapped):
        raise UsageError(
            f"The envelope is {short_repr(envelope)}; allowed: the name of a robot, or a function that returns a "
            "controller around the one that it is given, as its 'controller'.",
            "pass envelope=lambda controller: EnvelopeController(controller, ...)",
        )
    return wrapped


def _check_layers(controllers: Any, envelope: Any, telemetry: Any) -> None:
    """Refuse arguments of another type than those of ``build_stack``; raises UsageError naming the first."""
    listed = isinstance(controllers, Sequence) and not isinstance(controllers, str)
    if not listed or not all(isinstance(name, str) for name in controllers):
        raise UsageError(f"controllers is {controllers!r:.80}; allowed: a list of names.", 'pass controllers=["rtc"]')
    if envelope is not None and not isinstance(envelope, str) and not callable(envelope):
        raise UsageError(f"envelope is {envelope!r:.80}; allowed: the name of a robot, or a function that wraps a "
                         "controller.", 'pass envelope="franka-panda"')  # fmt: skip
    if telemetry is not None and not callable(telemetry) and not isinstance(telemetry, Telemetry):
        raise UsageError(f"telemetry is {telemetry!r:.80}; allowed: a function that takes a record, or Telemetry(...).",
                         "pass telemetry=records.append")  # fmt: skip


def rate_factor(controllers: Sequence[str]) -> int:
    """Return the control rate of the robot by that of the policy: more than 1 with an interpolation."""
    return math.prod(given.get("factor", 1) for given in options_of(controllers).values())


def _limited(
    policy: Policy, deadline_ms: float | None, clock: Callable[[], float], recorder: Recorder | Replay | None
) -> Policy:
    """Return a policy with the check of its actions, which an open bundle has already, its deadline and its record."""
    checked = policy if isinstance(policy, BundlePolicy) else CheckedPolicy(policy)
    limited = checked if deadline_ms is None else Deadline(checked, deadline_ms, clock=clock)
    return limited if recorder is None else recorder.wrap_policy(limited)


def _ladder(
    player: Any,
    spec: PolicySpec,
    options: Fallback,
    deadline_ms: float | None,
    clock: Callable[[], float],
    recorder: Recorder | Replay | None,
) -> FallbackLadder:
    reader = clock if recorder is None else recorder.follow(clock)
    rungs: list[Rung] = [ChunkRung(player, options.max_age_ms)] if hasattr(player, "rest") else []
    if options.policy is not None:
        check_same_actions(spec, options.policy.spec)
        second = ChunkQueue(_limited(options.policy, deadline_ms, clock, recorder), clock=reader)
        rungs.append(PolicyRung(second, FALLBACK))
    start = None if options.start is None else start_pose(options.start, spec.action)
    ramp = max(1, round(options.ramp_s * spec.rate))
    steps = max(1, round(options.hold_s * spec.rate))
    rungs += [Hold(spec.action, steps, ramp=ramp, neutral=options.neutral),
              Stop(spec.action, ramp=ramp, neutral=options.neutral)]  # fmt: skip
    return FallbackLadder(player, rungs, misses=options.misses, window=options.window, recover=options.recover,
                          latch=options.latch, start=start, clock=reader)  # fmt: skip


def check_deadline(spec: PolicySpec, deadline_ms: float | None, *, waits: bool = True, factor: int = 1) -> None:
    """Refuse a deadline that is not a number above 0 or, where a control step waits for it, longer than the step.

    Args:
        factor: Control steps of the robot for each one of the policy.

    Raises:
        UsageError: naming the deadline and what is allowed.
    """
    check_positive("deadline_ms", deadline_ms, "a number of milliseconds", optional=True)
    if deadline_ms is None or not waits or not spec.control_hz:
        return
    if deadline_ms > (period := 1000 / (spec.control_hz * factor)):
        raise UsageError(
            f"The deadline of {deadline_ms:g} ms is longer than the control period of {period:g} ms, and the "
            "controller waits for each inference: the next step would come before this one has its action.",
            f"pass deadline_ms up to {period:g}, or a controller that acts while the policy infers: "
            "rtc:background=true",
        )


def policy_ms(deadline_ms: float | None, options: Fallback) -> float:
    """Return the part of a deadline that is kept for the second policy, in milliseconds; 0 without a deadline.

    Raises:
        UsageError: when nothing is left for the first one, or there is no deadline to take a part of.
    """
    if deadline_ms is None and options.policy_ms is not None:
        raise UsageError("policy_ms is a part of the deadline, and there is none.", "pass deadline_ms, too")
    if deadline_ms is None:
        return 0.0
    own = deadline_ms / 2 if options.policy_ms is None else options.policy_ms
    if own >= deadline_ms:
        raise UsageError(
            f"{own:g} of {deadline_ms:g} ms are kept for the second policy; nothing is left for the first.",
            f"pass Fallback(policy_ms=...) below {deadline_ms:g}",
        )
    return own


def check_same_actions(first: PolicySpec, second: PolicySpec) -> None:
    """Refuse a second policy whose actions mean something else to the robot than those of the first.

    Raises:
        UsageError: naming the first difference.
    """
    for what in ("kind", "mode", "labels", "robot_width"):
        ours, others = getattr(first.action, what), getattr(second.action, what)
        if ours != others:
            raise UsageError(
                f"The second policy's action has the {what} {others!r}, that of the first {ours!r}.",
                "fall back to a policy with the same action",
            )
    if rotations_of(first.action) != rotations_of(second.action):
        raise UsageError(
            "The second policy's action has other rotations, or in other places or forms, than that of the first.",
            "fall back to a policy with the same action",
        )
    if first.action.units() != second.action.units() or first.control_hz != second.control_hz:
        raise UsageError(
            f"The second policy acts in {second.action.units()} at {second.control_hz} Hz, the first in "
            f"{first.action.units()} at {first.control_hz} Hz.",
            "fall back to a policy with the same units and rate",
        )


def robot_envelope(
    spec: PolicySpec, robot: str, factor: int = 1, clock: Callable[[], float] = time.monotonic
) -> Wrapper:
    """Return the wrapper that keeps the actions of a policy within the limits of a robot.

    Args:
        factor: Control steps of the robot for each one of the policy.

    Raises:
        ProfileError: when no robot has that name.
        UsageError: when the limits do not fit the action, no input is known to be the measured position, or it has
            another unit than the limits.
    """
    from vlatool.runtime.control.envelope import EnvelopeController
    from vlatool.runtime.envelope import RobotLimits, check_position, envelope_of

    limits = RobotLimits.named(robot)
    envelope = envelope_of(spec, limits, period_s=1 / (spec.rate * factor), clock=clock)
    bounded = any(joint.low is not None for joint in limits.joints)
    position = measured_position(spec) if bounded else None
    if position is not None:
        check_position(next(tensor for tensor in spec.inputs if tensor.name == position), envelope.limits)
    return lambda controller: EnvelopeController(controller, envelope, position=position)


def measured_position(spec: PolicySpec) -> str:
    """Return the input that says where the robot is: the one with the labels of the action.

    Raises:
        UsageError: when there is none, or several.
    """
    names = [tensor.name for tensor in spec.inputs if tensor.labels and tensor.labels == spec.action.labels]
    if len(names) == 1:
        return names[0]
    raise UsageError(
        f"{len(names)} inputs have the labels of the action; one has to be the position at which the robot starts.",
        "label the input as the action, or pass envelope=lambda controller: EnvelopeController(controller, "
        "envelope_of(policy.spec, limits), position=NAME)",
    )


def prepare_process() -> None:
    """Keep Python itself from delaying answers: threads give way sooner, no garbage is looked for in what is loaded.

    ``sys.setswitchinterval`` is lowered to ``SWITCH_S`` where it is longer; ``gc.freeze`` exempts the objects that are
    there now from garbage collection.
    """
    sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_S))
    gc.collect()
    gc.freeze()
