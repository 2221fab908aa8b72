"""A run of a controller on a bus, from its name to its summary: open everything, run, close everything."""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.buses import ActionBus, Fault, NamingBus, QoS, RosWords, open_bus
from vlatool.errors import OutputError, UsageError
from vlatool.messages import Message
from vlatool.messages.std_msgs import String
from vlatool.nodes.fault_watch import FaultWatch, to_plain_faults
from vlatool.nodes.instruction_action import InstructionAction
from vlatool.nodes.launch import PolicyOptions, open_controller, record_of
from vlatool.nodes.run_log import Background, RunLog, StepPublisher
from vlatool.nodes.runner import Runner, RunSummary
from vlatool.nodes.settings import to_plain
from vlatool.nodes.step_record import ControllerRecord
from vlatool.nodes.stepper import check_controller, topics_of
from vlatool.nodes.trace import Trace, watch_levels

SETTLE_S = 0.5
"""Recorders look for new topics ten times a second (``ros2 bag record``, ``vlatool record``); the first step of a
controller waits for them, so that a recording begins with it. A bus whose recorders are slower says ``settle_s``."""


@dataclass(frozen=True)
class RunPlan:
    """What is to run.

    Args:
        controller: Name of the controller.
        settings: Its settings, as JSON has them.
        policy: Its policy.
        bus: Bus, as ``open_bus`` takes it.
        node: Name of the node; ``vlatool_CONTROLLER`` when empty.
        topics: Other topics than those of the controller.
        seconds: Time after which the run ends; at a signal when None.
        wait_s: Time for which the publishers of required inputs are waited for; the run starts without them, too.
        record: New file for the log of the run; None for none.
        report: New HTML file; None for none.
        shared: Whether others may publish the controller's outputs, too.
        instruction: Text that is published to the controller's input of the name ``instruction``, or to the only one of
            texts, before its first step.
        settle_s: Time from the announcement of the node's topics to its first step, in seconds; the bus's when None.
        words: What a launcher of ROS says of the node; None without one.
    """

    controller: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    policy: PolicyOptions = field(default_factory=PolicyOptions)
    bus: str = ""
    node: str = ""
    topics: Mapping[str, str] = field(default_factory=dict)
    seconds: float | None = None
    wait_s: float = 1.0
    record: Path | None = None
    report: Path | None = None
    shared: bool = False
    instruction: str = ""
    settle_s: float | None = None
    words: RosWords | None = None


@dataclass(frozen=True)
class RunResult:
    """What a run was.

    Args:
        about: What ran.
        summary: Steps and times.
        lost: Reports of steps that were neither published nor logged, because the disk or the bus was too slow.
        log_full: Whether the log reached its limit before the end.
        failure: Why the records of the steps ended before the run did; empty where they did not.
        faults: What went wrong on the bus, one entry for each topic.
    """

    about: ControllerRecord
    summary: RunSummary
    lost: int = 0
    log_full: bool = False
    failure: str = ""
    faults: tuple[Fault, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        summary = self.summary
        return {
            "controller": self.about.controller, "node": self.about.node, "topics": dict(self.about.topics),
            "steps": summary.steps, "skipped": summary.skipped, "seconds": summary.seconds, "status": summary.status,
            "late_ms": spread(summary.late_ms), "compute_ms": spread(summary.compute_ms),
            "overhead_ms": spread(summary.overhead_ms), "overwritten": summary.overwritten, "lost_records": self.lost,
            "log_full": self.log_full, "failure": self.failure, "faults": to_plain_faults(self.faults),
        }  # fmt: skip


def spread(times: list[float]) -> dict[str, float | int | None]:
    """Return median, 99th percentile and number of some times."""
    if not times:
        return {"p50": None, "p99": None, "samples": 0}
    p99 = float(np.percentile(times, 99, method="higher"))
    return {"p50": float(np.median(times)), "p99": p99, "samples": len(times)}


def run_on_bus(
    plan: RunPlan,
    on_start: Callable[[ControllerRecord], None] = lambda about: None,
    on_end: Callable[[RunResult, Trace], None] = lambda result, trace: None,
    on_missing: Callable[[tuple[str, ...]], None] = lambda topics: warnings.warn(waiting(topics), stacklevel=3),
    on_fault: Callable[[Fault], None] = lambda fault: None,
    on_unheard: Callable[[tuple[str, ...]], None] = lambda topics: None,
) -> RunResult:
    """Run a controller on a bus until its time is over, or a signal or a failure ends it.

    Args:
        on_start: Called with what runs, before its first step.
        on_missing: Called with topics of required inputs that nobody publishes yet; it warns when not given.
        on_end: Called with what it was and with its trace, however it ended, once the robot is at rest.
        on_fault: Called, from another thread, with the first fault of the bus on each topic.
        on_unheard: Called with topics of commands that nobody subscribes to when the run begins.

    Raises:
        UsageError: when something is not allowed or missing, a file exists already.
        BusError: as ``Runner`` does, or when the bus cannot be reached.
        Exception: what a step raised, after the robot was brought to rest.
    """
    refuse_outputs(plan)
    if not plan.bus:
        raise UsageError("No bus is named.", "pass --bus BUS, such as --bus zenoh, or --dry-run")
    controller = open_controller(plan.controller, plan.settings, plan.policy)
    trace = Trace()
    with contextlib.ExitStack() as stack:
        stack.callback(_close_policy, controller)
        bus = open_bus(plan.bus, node_of(plan), plan.words)
        stack.callback(bus.close)
        node = bus.full_node if isinstance(bus, NamingBus) else node_of(plan)
        background = Background()
        stack.callback(background.close)
        runner = Runner(controller, bus, topics=plan.topics, observers=[background], alone=not plan.shared)
        about = record_of(plan.controller, controller, node, runner.topics, plan.policy)
        name = _instruction_input(controller, required=bool(plan.instruction))
        say = bus.publisher(runner.written_topics[name], String, QoS(reliable=True, latched=True)) if name else None
        publish_step = StepPublisher(bus, about)
        log = None if plan.record is None else RunLog(plan.record, about)  # a run that is refused leaves none
        if plan.report is not None:
            watch_levels(bus, trace)
        background.observe(publish_step, trace, FaultWatch(bus, on_fault), *([] if log is None else [log]))
        on_start(about)
        if say is not None and isinstance(bus, ActionBus):
            background.observe(InstructionAction(bus, node, say, name))
        time.sleep(getattr(bus, "settle_s", SETTLE_S) if plan.settle_s is None else plan.settle_s)
        if say is not None and plan.instruction:
            say(String(plan.instruction))
        if missing := runner.missing(plan.wait_s):
            on_missing(missing)
        if unheard := runner.unheard_topics():
            on_unheard(unheard)
        try:
            runner.run(plan.seconds)
        finally:
            result = _closed(about, runner, background, log)
            on_end(result, trace)
    return result


def waiting(topics: tuple[str, ...]) -> str:
    """Return a sentence on topics that nobody publishes."""
    return f"nobody publishes {', '.join(topics)} yet; the controller waits for it"


def unheard_text(topics: tuple[str, ...]) -> str:
    """Return a sentence on topics of commands that nobody subscribes to."""
    return f"nobody hears {', '.join(topics)} yet: no robot obeys it"


def _instruction_input(controller: Any, required: bool) -> str:
    """Return the controller's input of instructions; empty where it has none and none is required.

    Raises:
        UsageError: where it has none, and one is required.
    """
    texts = [entry.name for entry in controller.inputs if entry.message is String]
    if "instruction" in texts:
        return "instruction"
    if required and len(texts) != 1:
        raise UsageError("The controller takes no instruction.", "leave --instruction out")
    return texts[0] if required else ""


def dry_run(plan: RunPlan) -> dict[str, Any]:
    """Return what a run would be, as plain values: settings and topics with their types; no bus is opened.

    Raises:
        UsageError, InputError, MissingExtra: as ``run_on_bus`` does until it opens the bus.
    """
    refuse_outputs(plan)
    controller = open_controller(plan.controller, plan.settings, plan.policy)
    topics = topics_of(controller, plan.topics)
    check_controller(controller)
    _close_policy(controller)

    def entry(each: Any, kind: type[Message]) -> dict[str, str]:
        return {"name": each.name, "topic": topics[each.name], "type": kind.TYPE}

    return {
        "controller": plan.controller,
        "node": node_of(plan) if plan.words is None else plan.words.name_for(node_of(plan)),
        "rate_hz": controller.rate_hz,
        "inputs": [entry(each, each.message) for each in controller.inputs],
        "outputs": [entry(each, each.message) for each in controller.outputs],
        "services": [entry(each, each.request) for each in controller.services],
        "settings": to_plain(controller),
    }


def _close_policy(controller: Any) -> None:
    policy: Any = getattr(controller, "policy", None)
    if hasattr(policy, "close"):
        policy.close()


def node_of(plan: RunPlan) -> str:
    """Return the name of the node."""
    return plan.node or default_node(plan.controller)


def default_node(controller: str) -> str:
    """Return the name of the node of a controller."""
    return f"vlatool_{controller.replace('-', '_')}"


def _closed(about: ControllerRecord, runner: Runner, background: Background, log: RunLog | None) -> RunResult:
    background.close()
    failure = background.failure
    if log is not None:
        try:
            log.close(background.lost)
        except OSError as error:
            failure = failure or error
    full = log is not None and log.full
    return RunResult(about, runner.summary, background.lost, full, _reason(failure), tuple(runner.bus.faults()))


def _reason(failure: Exception | None) -> str:
    """Return why records are not whole; empty without a failure."""
    if isinstance(failure, OSError) and failure.filename:
        return f"{failure.filename}: {failure.strerror}"
    return "" if failure is None else f"{type(failure).__name__}: {failure}"


def refuse_outputs(plan: RunPlan) -> None:
    """Raise OutputError where a file of a run exists already, cannot be created, or is named twice."""
    paths = [path for path in (plan.record, plan.report) if path is not None]
    for path in paths:
        folder = path.absolute().parent
        if path.exists() or path.is_symlink():
            raise OutputError(f"{path} exists already.", "name a new file, or remove it")
        if not folder.is_dir():
            raise OutputError(f"{path} cannot be written: {folder} is not a directory.", "create it first")
        if not os.access(folder, os.W_OK):
            raise OutputError(f"{path} cannot be written: {folder} is not writable.", "name a directory of yours")
    if len({path.resolve() for path in paths}) < len(paths):
        raise OutputError(f"{paths[0]} is named twice: for the log and for the report.", "name two files")
