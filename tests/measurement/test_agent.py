"""A whole measurement on this machine, in processes of its own."""

import json
import os
import subprocess

import pytest
from _processes import below

from vlatool.errors import BundleError, GateFailed, GraphError, UsageError
from vlatool.files.messages import from_json, to_json
from vlatool.machine.processes import python_command
from vlatool.measurement.agent import WORKER, measure
from vlatool.measurement.jobs import LatencyJob, Limits
from vlatool.measurement.results import Benchmark


def quiet(what, share):
    """Tell nobody."""


def test_a_measurement_holds_the_host_the_board_and_the_cold_starts(float_bundle):
    told = []
    job = LatencyJob((str(float_bundle.path),), iterations=20, warmup=1, cold=1)
    found = measure(job, lambda what, share: told.append(what))
    assert from_json(Benchmark, json.loads(json.dumps(to_json(found)))) == found
    assert found.host["cores"] >= 1
    assert {"opening", "measuring latency", "cold start of each in a fresh process"} <= set(told)
    (start,) = found.policies[0].cold
    assert start.total_ms > start.import_ms > 0
    assert found.telemetry.gauges["process.memory"].min > 10, "of the process that calls the policy"
    assert found.telemetry.counters["process.cpu"].difference >= 0


def test_what_does_not_fit_fails(float_bundle):
    with pytest.raises(GateFailed, match=r"does not fit: the process needs more than 30 MB"):
        measure(LatencyJob((str(float_bundle.path),), iterations=20, limits=Limits(memory_mb=30)), quiet)


def test_errors_of_the_worker_come_back(tmp_path, float_bundle):
    with pytest.raises(BundleError, match="No bundle at"):
        measure(LatencyJob((str(tmp_path / "none"),)), quiet)
    with pytest.raises(UsageError, match="Unknown engine 'foo'"):
        measure(LatencyJob((str(float_bundle.path),), engine="foo"), quiet)


def test_the_agent_speaks_json_lines(float_bundle, tmp_path):
    command = python_command("vlatool.measurement.agent")
    for bundle, last in ((float_bundle.path, "result"), (tmp_path / "none", "raised")):
        line = json.dumps(to_json(LatencyJob((str(bundle),), iterations=20))) + "\n"
        done = subprocess.run(command, input=line, text=True, capture_output=True, check=True)
        told = [json.loads(each) for each in done.stdout.splitlines()]
        assert last in told[-1]
        assert all("progress" in each for each in told[:-1])


def test_a_cold_start_that_fails_costs_nothing_else(float_bundle, monkeypatch):
    from vlatool.measurement import agent
    from vlatool.measurement.rows import cold_rows

    def fails(*_):
        raise GraphError("the bundle has gone.")

    monkeypatch.setattr(agent, "cold_start", fails)
    found = measure(LatencyJob((str(float_bundle.path),), iterations=20, warmup=1, cold=1), quiet)
    (one,) = cold_rows(found.policies[0])
    assert not one.known
    assert one.note == "the bundle has gone."


def test_nobody_is_left_when_telling_fails(float_bundle):
    workers = []

    def broken(what, share):
        workers.extend(below(os.getpid(), WORKER))
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        measure(LatencyJob((str(float_bundle.path),), iterations=20), broken)
    assert len(workers) == 1
    assert not workers[0].is_running()  # also not as a zombie


def test_a_worker_that_is_killed_is_named(float_bundle):
    def kill(what, share):
        if what == "measuring latency":
            for worker in below(os.getpid(), WORKER):
                worker.kill()

    with pytest.raises(GraphError, match=r"was killed \(SIGKILL\) while it was measured"):
        measure(LatencyJob((str(float_bundle.path),), iterations=20, limits=Limits(memory_mb=2000)), kill)
