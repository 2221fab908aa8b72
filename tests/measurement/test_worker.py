"""The process that calls the policies: with honest ones, and with those that cheat, stall or fail."""

import json
import subprocess

import numpy as np
import pytest
from _policies import Drawing, Garbage, Memoising, Stalling

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import BundleError
from vlatool.files.messages import to_json
from vlatool.machine.processes import python_command
from vlatool.measurement.answers import AnswerCheck
from vlatool.measurement.interleaved import Contestant, latency_measurements
from vlatool.measurement.jobs import LatencyJob, WorkerJob
from vlatool.measurement.validity import findings
from vlatool.measurement.worker import measure, open_policy, run_job
from vlatool.runtime.policy import Policy


def quiet(what, share):
    """Tell nobody."""


def job(bundle, **more):
    return LatencyJob((str(bundle.path),), **({"iterations": 40, "warmup": 1} | more))


def measured(policy, bundle, **more):
    contestant = Contestant("x", bundle, policy, observations_for(bundle, 16))
    return measure([contestant], job(bundle, **more), quiet, lambda: None)


@pytest.fixture
def policy(float_bundle):
    return Policy.open(float_bundle, threads=1, seed=0)


def test_every_call_is_kept_with_its_time(float_bundle, int8_bundle):
    found = run_job(LatencyJob((str(float_bundle.path), str(int8_bundle.path)), iterations=40, phases=True), quiet)
    for policy in found.policies:
        assert sum(map(len, policy.blocks_ms)) == len(policy.at_s) == 40
        assert policy.at_s == tuple(sorted(policy.at_s))
        assert (policy.answers.looked, policy.answers.strays) == (40, 0)
        assert policy.golden_error < 0.25
        assert policy.engines[0].providers == "CPUExecutionProvider"
        assert [graph.graph for graph in policy.record.graphs] == ["main"]
        phases = {phase.name: phase for phase in policy.phases}
        assert list(phases) == ["encode observation", "main", "decode action and the rest"]
        assert sum(phase.share_percent for phase in phases.values()) == pytest.approx(100, abs=15)
    assert found.policies[0].record.graphs[0].shares[0].macs == {"float32": 1.0}
    assert len(found.canary_ms) == 21
    assert found.cpu_s > 0
    assert 0 < found.wall_s <= found.ended_s - found.begun_s + 0.1


def test_the_run_lasts_as_long_as_it_should(policy, float_bundle):
    found = measured(policy, float_bundle, duration=0.5, check=False)
    assert found.wall_s >= 0.5
    assert len(found.policies[0].at_s) > 40
    assert found.policies[0].answers is None


def test_a_loop_at_a_rate(float_bundle):
    found = run_job(job(float_bundle, rate=200.0, iterations=60), quiet)
    policy = found.policies[0]
    assert len(policy.blocks_ms[0]) == len(policy.at_s) == 60
    assert policy.pace.period_ms == 5.0
    assert 0.25 <= found.wall_s <= 5
    assert policy.answers.looked == 60 - policy.pace.passed_over


def test_a_policy_that_returns_garbage_under_load_is_invalid(policy, float_bundle):
    found = measured(Garbage(policy, after=30), float_bundle)
    seen = findings(found, job(float_bundle))
    assert seen[0].effect == "invalid"
    assert "otherwise than in an unhurried pass" in seen[0].reason


def test_a_policy_that_remembers_is_invalid(policy, float_bundle):
    seen = findings(measured(Memoising(policy), float_bundle), job(float_bundle))
    assert [each for each in seen if each.effect == "invalid" and "from memory" in each.reason]


def test_an_honest_policy_is_not_invalid(policy, float_bundle):
    assert "invalid" not in {each.effect for each in findings(measured(policy, float_bundle), job(float_bundle))}


def test_stalls_show_in_the_tail(policy, float_bundle):
    found = measured(Stalling(policy), float_bundle, iterations=8000, check=False)
    samples = found.policies[0].samples
    assert sum(value >= 50 for value in samples) == 8
    mixed = np.random.default_rng(0).permutation(samples)  # so that all calls count, however busy the machine is
    told = {each.name: each for each in latency_measurements(mixed)}
    assert told["latency_max"].value >= 50
    assert told["latency_p99.9"].high >= 50
    assert told["latency_p90"].high < 50


def test_stalls_show_in_every_tick_that_they_cover(policy, float_bundle):
    stalling = Stalling(policy, every=100)
    found = measured(stalling, float_bundle, iterations=400, rate=200.0, check=False)
    samples = found.policies[0].blocks_ms[0]
    stalls = (stalling.calls - 2) // 100  # all but the last, which may come with the last ticks
    assert stalls >= 2
    assert sum(value > 5 for value in samples) >= 9 * stalls, "50 ms at 200 Hz cover ten ticks"
    assert found.policies[0].pace.misses >= 9 * stalls


def test_observations_are_started_over_so_that_noise_repeats(policy, float_bundle):
    found = measured(Drawing(policy), float_bundle, iterations=100)
    assert found.policies[0].answers == AnswerCheck(looked=100, strays=0, worst=0.0, first=-1)


def test_nothing_to_run_is_refused(float_bundle, copied):
    from dataclasses import replace

    from vlatool.bundle.bundle import seal

    bare = copied(float_bundle)
    seal(bare.path, replace(bare.manifest, graphs={}, program=(), source={}))
    with pytest.raises(BundleError, match="has nothing to run"):
        open_policy(str(bare.path), job(bare))


def test_the_process_waits_for_the_word_and_says_what_it_found(float_bundle: Bundle):
    lines = json.dumps(to_json(WorkerJob(job(float_bundle, iterations=20)))) + "\n\n\n"
    done = subprocess.run(python_command("vlatool.measurement.worker"), input=lines, text=True,
                          capture_output=True, check=True)  # fmt: skip
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert {"progress", "ready", "timed", "result"} == {key for line in told for key in line}
    assert np.concatenate(told[-1]["result"]["value"]["policies"][0]["blocks_ms"]).shape == (20,)
