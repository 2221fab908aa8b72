"""The scripts beside this file in their small form."""

from __future__ import annotations

import pytest
import two_systems
from _two_systems import two_systems as bundle_of_two_systems
from bad_outputs import graph_outputs, wrong_outputs
from damaged_files import trials
from endless import endless
from soak import soak
from telemetry_kills import kills
from ticks import run


@pytest.mark.parametrize("stubborn", [False, True])
def test_every_step_is_answered_by_its_deadline_and_no_late_action_is_used(stubborn: bool):
    found = run(2000, real=False, stubborn=stubborn)
    assert (found["answered"], found["late actions used"]) == (2000, 0)
    assert found["of which late"] > 300
    assert found["answers more than 1 ms beyond"] == 0


def test_by_the_clock_of_this_machine_too():
    found = run(40, real=True)
    assert (found["answered"], found["late actions used"]) == (40, 0)
    assert found["of which late"] > 3


def test_a_graph_without_end_is_stopped():
    found = endless(2)
    assert (found["stopped"], found["right afterwards"]) == (2, 2)


def test_a_fast_part_acts_on_values_of_a_bounded_age_beside_a_slow_part(capsys: pytest.CaptureFixture[str]):
    bundle = two_systems.slowed(bundle_of_two_systems().path, 300, 20.0, 2000.0)
    beside, together = two_systems.run(bundle, 0.75)
    assert len(beside["answers"]) == len(together["answers"]) == 15
    assert beside["sources"].get("policy", 0) >= 1
    assert 0 < beside["ages"].max() <= 2000 + 50
    assert "slow part in a thread: answers within 45 ms" in capsys.readouterr().out


def test_no_wrong_output_reaches_the_robot():
    found = wrong_outputs(700)
    assert (found["wrong"], found["reached the robot"]) == (600, 0)
    assert found["kinds"] == 17
    found = graph_outputs(100)
    assert found["wrong"] > 50
    assert found["reached the robot"] == 0


def test_nothing_grows_in_a_few_seconds_of_the_whole_stack():
    found = soak(2.5, 0.25)
    later = found["seen"][4:]
    assert found["steps"] > 50
    assert found["misses"] >= found["steps"] // 50
    assert (found["dropped"], found["failed"]) == (0, 0)
    assert (later[:, 3].max(), later[:, 2].max()) <= (later[0, 3] + 1, later[0, 2] + 3), "a client comes and goes"


def test_a_killed_process_leaves_a_run_that_can_be_replayed():
    assert kills(1)["bit-equal"] == 1


def test_no_damaged_record_is_read():
    for found in trials(200, seed=3).values():
        assert found["refused"] > 50
        assert found["unchanged"] < 20
