"""The action "run this instruction" for a controller that takes an instruction as a topic and reports a status.

A goal is published to the controller's instruction; the first word of its status ends the goal: ``arrived`` or
``done`` as succeeded, ``failed`` as aborted. A cancelled goal, and one whose time is over, publish an empty
instruction, which ends the motion.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from vlatool.buses import GOAL_ABORTED, GOAL_CANCELED, GOAL_SUCCEEDED, ActionBus, ActionType, Goal, Outcome
from vlatool.messages.std_msgs import String
from vlatool.messages.vlatool_msgs import (
    RunInstructionFeedback,
    RunInstructionGoal,
    RunInstructionResult,
)
from vlatool.nodes.stepper import StepReport

KIND = ActionType(
    "vlatool_msgs/action/RunInstruction", RunInstructionGoal, RunInstructionFeedback, RunInstructionResult
)
ENDS: Mapping[str, str] = {"arrived": GOAL_SUCCEEDED, "done": GOAL_SUCCEEDED, "failed": GOAL_ABORTED}
"""First word of a status -> how it ends a goal."""
LOOK_S, FEEDBACK_S = 0.02, 0.2


class InstructionAction:
    """Serves the action; an observer of the run.

    Args:
        bus: A bus that has actions.
        node: Name of the node; the action is ``/NODE/run_instruction``.
        say: Publishes an instruction to the controller.
        name: The controller's input that takes it.
    """

    def __init__(self, bus: ActionBus, node: str, say: Callable[[String], None], name: str = "instruction") -> None:
        self._say, self._name, self._lock = say, name, threading.Lock()
        self._status = ""
        self._heard = (-1, "")
        self.name = f"/{node}/run_instruction"
        bus.serve_action(self.name, KIND, self._run)

    def __call__(self, report: StepReport) -> None:
        """Take the status of a step, and which text it knew: how many came before it, and the text."""
        newest = report.snapshot.newest.get(self._name)
        with self._lock:
            self._status = report.command.status
            if newest is not None and isinstance(newest.message, String):
                self._heard = (newest.sequence, newest.message.data)

    def _now(self) -> tuple[str, int, str]:
        with self._lock:
            return (self._status, *self._heard)

    def _run(self, goal: Goal) -> Outcome:
        message: Any = goal.message
        text = message.instruction.strip()
        if not text:
            return Outcome(GOAL_ABORTED, RunInstructionResult(False, "The goal has no instruction."))
        began, told_s = time.monotonic(), -FEEDBACK_S
        before, own = self._now()[1], -1
        self._say(String(text))
        while not goal.canceled.wait(LOOK_S):
            elapsed = time.monotonic() - began
            status, count, heard = self._now()
            word = (status.split() or [""])[0]
            if heard.strip() == text and count > before:
                own = count
            elif count > max(own, before + 1):  # its own came before this one, whether or not a step saw it
                return Outcome(GOAL_ABORTED, RunInstructionResult(False, "another instruction came"))
            if own >= 0 and word in ENDS:
                return Outcome(ENDS[word], RunInstructionResult(ENDS[word] == GOAL_SUCCEEDED, status))
            if message.timeout_s > 0 and elapsed > message.timeout_s:
                self._say(String(""))
                return Outcome(
                    GOAL_ABORTED, RunInstructionResult(False, f"not done in {message.timeout_s:g} s: {status}")
                )
            if elapsed - told_s >= FEEDBACK_S:
                told_s = elapsed
                goal.feedback(RunInstructionFeedback(status, elapsed))
        self._say(String(""))
        return Outcome(GOAL_CANCELED, RunInstructionResult(False, "canceled"))
