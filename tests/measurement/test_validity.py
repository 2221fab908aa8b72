"""What is seen beside the latencies decides whether they can be trusted."""

from dataclasses import replace

import pytest
from _runs import QUIET, run_of

from vlatool.measurement.answers import AnswerCheck, Memory
from vlatool.measurement.clock_drift import canary_ms, drift
from vlatool.measurement.jobs import LatencyJob, Limits
from vlatool.measurement.results import GraphEngine, PolicyRun
from vlatool.measurement.validity import findings, validity
from vlatool.runtime.engine_record import EngineRecord, GraphRecord
from vlatool.telemetry import Change, Gauge

JOB = LatencyJob(("a",))


def found(policy=None, **more):
    options = {"blocks_ms": ((1.0,) * 10,) * 20, "at_s": ()} | (policy or {})
    return run_of(PolicyRun("int8", **options), **more)


def telemetry(**more):
    return replace(QUIET, **more)


def seen_in(what, duration_is_sustained=False, **job):
    return findings(what, replace(JOB, **job), duration_is_sustained)


def only(what, **more):
    (one,) = seen_in(what, **more)
    assert one.reason
    return one


def test_nothing_seen_is_valid():
    assert seen_in(found()) == ()
    assert validity(()) == "valid"
    assert seen_in(found(telemetry=None)) == ()


def test_other_answers_are_invalid():
    answers = AnswerCheck(looked=100, strays=3, worst=0.5, first=40)
    one = only(found(policy={"answers": answers}))
    assert one.effect == "invalid"
    assert "3 of 100" in one.reason
    assert "call 41" in one.reason
    assert "difference up to 0.5" in one.reason
    assert validity([one]) == "invalid"
    nan = only(found(policy={"answers": replace(answers, worst=None)}))
    assert "(not finite, or of another shape, first in call 41)" in nan.reason


def test_answers_from_memory_are_invalid():
    memory = Memory(ratio=3.0, low=2.5, pairs=40)
    assert only(found(policy={"memory": memory})).effect == "invalid"
    assert seen_in(found(policy={"memory": replace(memory, low=1.0)})) == ()


def test_a_busy_host_is_suspect():
    assert seen_in(found(host={"processors_busy": 0.3, "cores_online": 2})) == ()
    assert seen_in(found(host={"processors_busy": None, "cores_online": 2})) == ()
    assert "kept 1.0 of 2 processors busy" in only(found(host={"processors_busy": 1.0, "cores_online": 2})).reason


def test_threads_that_share_processors_are_told_and_not_blamed_on_others():
    one = only(found(switches=5000), threads=8, limits=Limits(cpus=(0, 1)))
    assert "8 threads share 2 processors" in one.reason
    assert one.remedy == "--threads 2, or fewer"
    assert seen_in(found(), threads=4) == ()
    assert "share 1 processor:" in only(found(), threads=2, limits=Limits(cores=1)).reason


def test_an_engine_that_does_not_run_as_asked_is_suspect():
    graph = GraphRecord("main", {"int8": 1.0}, (), (), ("graph 'main': int8 is promised; it ran float32.",))
    record = EngineRecord("ort_cpu", "ONNX Runtime", "", "", "", (graph,))
    one = only(found(policy={"record": record}))
    assert (one.effect, "as asked: graph 'main': int8 is promised; it ran float32" in one.reason) == ("suspect", True)


def test_a_golden_action_that_is_off_is_suspect():
    one = only(found(policy={"golden_error": 0.12, "golden_explained": 0.045}))
    assert "0.12" in one.reason
    assert "rounding explains 0.045" in one.reason
    assert seen_in(found(policy={"golden_error": 0.035, "golden_explained": 0.045})) == ()


def test_answers_that_were_not_looked_at_are_noted():
    assert only(found(policy={"engines": (GraphEngine("main", "ort_cpu", "", "CPU", "float32", ""),)})).effect == "note"


def test_a_run_that_was_full_is_noted():
    what = found(policy={"at_s": range(2_000_000)})
    assert "2,000,000 calls" in only(what, iterations=200).reason
    assert seen_in(what, iterations=2_000_000) == ()


def test_a_contended_processor_is_suspect():
    one = only(found(switches=5000))
    assert (one.effect, "500 times in a second" in one.reason) == ("suspect", True)
    stolen = telemetry(counters={"process.machine_steal": Change("s", 1.0, 10.0, "")})
    assert "2.5%" in only(found(telemetry=stolen)).reason
    little = telemetry(counters={"process.machine_steal": Change("s", 0.1, 10.0, "")})
    assert seen_in(found(telemetry=little)) == ()


def test_throttling_is_suspect_unless_the_run_was_meant_to_heat():
    hot = telemetry(throttled=True, throttling=("soft temperature limit (set in a sample)",))
    assert only(found(telemetry=hot)).effect == "suspect"
    assert only(found(telemetry=hot), duration_is_sustained=True).effect == "note"


@pytest.mark.parametrize(("last", "told"), [(1.2, "20% slower"), (0.8, "20% faster"), (1.04, "")])
def test_a_processor_that_changes_its_speed_is_suspect(last, told):
    seen = seen_in(found(canary_ms=(1.0,) * 10 + (last,) * 10))
    assert [told in each.reason for each in seen] == ([True] if told else [])


def test_a_policy_that_becomes_slower_is_suspect():
    blocks = ((1.0,) * 10,) * 15 + ((1.1,) * 10,) * 5
    one = only(found(policy={"blocks_ms": blocks}))
    assert "10% slower" in one.reason
    assert "--sustained 600" in one.remedy
    assert "--duration 600" in only(found(policy={"blocks_ms": blocks}), rate=50.0).remedy
    assert seen_in(found(policy={"blocks_ms": blocks}), duration_is_sustained=True) == ()
    assert seen_in(found(policy={"blocks_ms": ((1.0,),) * 15 + ((2.0,),) * 5})) == (), "too few to say"
    several = found(policy={"blocks_ms": blocks})
    assert seen_in(replace(several, policies=several.policies * 2)) == (), "several slow down together"


def held(values):
    return Gauge("MB", min(values), sum(values) / len(values), max(values), (), values, "")


def test_memory_that_grows_is_suspect():
    grows = telemetry(gauges={"process.memory": held((100.0,) * 20 + (140.0,) * 10)})
    assert "100 to 140 MB" in only(found(telemetry=grows)).reason
    steady = telemetry(gauges={"process.memory": held((60.0,) * 3 + (100.0,) * 27)})
    assert seen_in(found(telemetry=steady)) == ()
    assert seen_in(found(telemetry=telemetry(gauges={"process.memory": held((1.0, 900.0))}))) == ()


def test_a_governor_that_follows_the_load_is_noted():
    one = only(found(host={"governor": "schedutil", "cores": 4}))
    assert (one.effect, "cpupower" in one.remedy) == ("note", True)
    assert validity([one]) == "valid"
    assert seen_in(found(host={"governor": "performance", "cores": 4})) == ()


def test_the_worst_comes_first():
    seen = seen_in(found(switches=5000, host={"governor": "powersave"}, policy={"memory": Memory(2.0, 2.0, 40)}))
    assert [each.effect for each in seen] == ["invalid", "suspect", "note"]


def test_the_canary_takes_time_and_drifts_by_halves():
    assert 0 < canary_ms() < 1000
    assert drift([1.0] * 3) == 0.0
    assert drift([1.0, 1.0, 1.0, 1.1, 1.1]) == pytest.approx(0.1)
