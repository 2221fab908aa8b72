"""The action "run this instruction" over the bus of one process."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import pytest

from vlatool.buses import GOAL_ABORTED, GOAL_CANCELED, GOAL_SUCCEEDED, QoS, open_bus
from vlatool.controllers import Command, Input
from vlatool.messages.std_msgs import String
from vlatool.messages.vlatool_msgs import RunInstructionGoal
from vlatool.nodes.instruction_action import KIND, InstructionAction
from vlatool.nodes.runner import Runner


@dataclass(frozen=True)
class Walker:
    """Walks for five steps, then arrives; ``fall`` fails at once, ``walk on`` never ends."""

    rate_hz: float = 100.0
    inputs = (Input("instruction", "/instruction", String, required=False, latched=True),)
    outputs = ()
    services = ()

    def start(self):
        return ("", 0)

    def step(self, snapshot, state):
        text, steps = state
        for reading in snapshot.readings.get("instruction", ()):
            text, steps = reading.message.data, 0
        ends = {"": "idle", "fall": "failed it fell", "walk on": "running on"}
        status = ends.get(text, "arrived there" if steps >= 5 else "running")
        return Command(status=status), (text, steps + 1)

    def rest(self):
        return Command()


@pytest.fixture
def slow_s():
    """How long an instruction is on its way, in seconds, under the key ``s``; empty for a bus that is fast."""
    return {}


@pytest.fixture
def client(request, slow_s):
    buses = [open_bus(f"sim:{request.node.name}", name) for name in ("vlatool_walker", "client")]
    send_on = buses[0].publisher("/instruction", String, QoS(latched=True))

    def say(text):
        threading.Timer(slow_s.get("s", 0.0), send_on, (text,)).start() if slow_s else send_on(text)

    action = InstructionAction(buses[0], "vlatool_walker", say)
    runner = Runner(Walker(), buses[0], observers=[action])
    thread = threading.Thread(target=runner.run)
    thread.start()
    yield buses[1]
    runner.stop()
    thread.join()
    for bus in buses:
        bus.close()


def send(client, text, timeout_s=0.0, feedback=None):
    return client.send_goal("/vlatool_walker/run_instruction", KIND, RunInstructionGoal(text, timeout_s), feedback)


def test_goals_end_by_the_status(client):
    told = []
    outcome = send(client, " go to the ball ", feedback=told.append).result(5)
    assert (outcome.status, outcome.result.success, outcome.result.message) == (GOAL_SUCCEEDED, True, "arrived there")
    assert told
    assert told[0].elapsed_s >= 0
    outcome = send(client, "fall").result(5)  # the status before it was arrived: that of the last goal does not count
    assert (outcome.status, outcome.result.message) == (GOAL_ABORTED, "failed it fell")
    assert send(client, "go").result(5).status == GOAL_SUCCEEDED


def test_a_goal_that_is_long_on_its_way_does_not_end_by_the_status_of_the_last_one(client, slow_s):
    assert send(client, "go").result(5).status == GOAL_SUCCEEDED
    slow_s["s"] = 0.3
    outcome = send(client, "fall").result(5)
    assert (outcome.status, outcome.result.message) == (GOAL_ABORTED, "failed it fell")


def test_a_goal_ends_when_another_instruction_replaces_its_own(client):
    other = client.publisher("/instruction", String, QoS(latched=True))
    goal = send(client, "walk on")
    time.sleep(0.2)
    other(String("go"))
    outcome = goal.result(5)
    assert (outcome.status, outcome.result.message) == (GOAL_ABORTED, "another instruction came")


def test_cancel_and_time_out_end_the_motion(client):
    goal = send(client, "walk on")
    time.sleep(0.1)
    goal.cancel()
    assert goal.result(5).status == GOAL_CANCELED
    outcome = send(client, "walk on", 0.1).result(5)
    assert (outcome.status, outcome.result.message) == (GOAL_ABORTED, "not done in 0.1 s: running on")
    assert send(client, " ").result(5).result.message == "The goal has no instruction."
