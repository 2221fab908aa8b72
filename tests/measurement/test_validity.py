"""What is seen beside the latencies decides whether they can be trusted."""

import pytest

from vlatool.measurement.clock_drift import canary_ms, drift
from vlatool.measurement.validity import findings, validity


def found(**more):
    policy = {"name": "int8", "blocks_ms": [[1.0] * 10] * 20, "at_s": [], "answers": None, "memory": None} | more.pop(
        "policy", {}
    )
    return {"wall_s": 10.0, "switches": 30, "canary_ms": [1.0] * 21, "host": {"cores": 4}, "policies": [policy],
            "telemetry": {"counters": {}, "gauges": {}, "throttled": None, "throttling": []}} | more  # fmt: skip


def telemetry(**more):
    return {"counters": {}, "gauges": {}, "throttled": None, "throttling": []} | more


def only(what, **more):
    (one,) = findings(what, **more)
    assert one.reason
    return one


def test_nothing_seen_is_valid():
    assert findings(found()) == ()
    assert validity(()) == "valid"
    assert findings(found(telemetry=None)) == ()


def test_other_answers_are_invalid():
    answers = {"looked": 100, "strays": 3, "worst": 0.5, "first": 40}
    one = only(found(policy={"answers": answers}))
    assert one.effect == "invalid"
    assert "3 of 100" in one.reason
    assert "call 41" in one.reason
    assert "difference up to 0.5" in one.reason
    assert validity([one]) == "invalid"
    nan = only(found(policy={"answers": answers | {"worst": None}}))
    assert "(not finite, or of another shape, first in call 41)" in nan.reason


def test_answers_from_memory_are_invalid():
    memory = {"ratio": 3.0, "low": 2.5, "pairs": 40, "remembers": True}
    assert only(found(policy={"memory": memory})).effect == "invalid"
    assert findings(found(policy={"memory": memory | {"remembers": False}})) == ()


def test_a_busy_host_is_suspect():
    assert findings(found(host={"processors_busy": 0.3, "cores_online": 2})) == ()
    assert findings(found(host={"processors_busy": None, "cores_online": 2})) == ()
    assert "kept 1.0 of 2 processors busy" in only(found(host={"processors_busy": 1.0, "cores_online": 2})).reason


def test_threads_that_share_processors_are_told_and_not_blamed_on_others():
    one = only(found(switches=5000, job={"threads": 8, "limits": {"cpus": [0, 1]}}, host={"cores": 4}))
    assert "8 threads share 2 processors" in one.reason
    assert one.remedy == "--threads 2, or fewer"
    assert findings(found(job={"threads": 4, "limits": {}}, host={"cores": 4})) == ()
    assert "share 1 processor:" in only(found(job={"threads": 2, "limits": {"cores": 1}}, host={"cores": 4})).reason


def test_a_golden_action_that_is_off_is_suspect():
    assert "0.12" in only(found(policy={"golden_error": 0.12})).reason
    assert findings(found(policy={"golden_error": 0.001})) == ()


def test_answers_that_were_not_looked_at_are_noted():
    assert only(found(policy={"engines": [{"graph": "main"}]})).effect == "note"


def test_a_run_that_was_full_is_noted():
    what = found(policy={"at_s": range(2_000_000)}, job={"iterations": 200})
    assert "2,000,000 calls" in only(what).reason
    assert findings(found(policy={"at_s": range(2_000_000)}, job={"iterations": 2_000_000})) == ()


def test_a_contended_processor_is_suspect():
    one = only(found(switches=5000))
    assert (one.effect, "500 times in a second" in one.reason) == ("suspect", True)
    stolen = telemetry(counters={"process.machine_steal": {"difference": 1.0, "seconds": 10.0}})
    assert "2.5%" in only(found(telemetry=stolen)).reason
    little = telemetry(counters={"process.machine_steal": {"difference": 0.1, "seconds": 10.0}})
    assert findings(found(telemetry=little)) == ()


def test_throttling_is_suspect_unless_the_run_was_meant_to_heat():
    hot = telemetry(throttled=True, throttling=["soft temperature limit (set in a sample)"])
    assert only(found(telemetry=hot)).effect == "suspect"
    assert only(found(telemetry=hot), duration_is_sustained=True).effect == "note"


@pytest.mark.parametrize(("last", "told"), [(1.2, "20% slower"), (0.8, "20% faster"), (1.04, "")])
def test_a_processor_that_changes_its_speed_is_suspect(last, told):
    seen = findings(found(canary_ms=[1.0] * 10 + [last] * 10))
    assert [told in each.reason for each in seen] == ([True] if told else [])


def test_a_policy_that_becomes_slower_is_suspect():
    blocks = [[1.0] * 10] * 15 + [[1.1] * 10] * 5
    one = only(found(policy={"blocks_ms": blocks}))
    assert "10% slower" in one.reason
    assert "--sustained 600" in one.remedy
    assert "--duration 600" in only(found(policy={"blocks_ms": blocks}, job={"rate": 50.0})).remedy
    assert findings(found(policy={"blocks_ms": blocks}), duration_is_sustained=True) == ()
    assert findings(found(policy={"blocks_ms": [[1.0]] * 15 + [[2.0]] * 5})) == (), "too few to say"
    several = found(policy={"blocks_ms": blocks})
    assert findings({**several, "policies": several["policies"] * 2}) == (), "several slow down together"


def test_memory_that_grows_is_suspect():
    grows = telemetry(gauges={"process.memory": {"values": [100.0] * 20 + [140.0] * 10}})
    assert "100 to 140 MB" in only(found(telemetry=grows)).reason
    steady = telemetry(gauges={"process.memory": {"values": [60.0] * 3 + [100.0] * 27}})
    assert findings(found(telemetry=steady)) == ()
    assert findings(found(telemetry=telemetry(gauges={"process.memory": {"values": [1.0, 900.0]}}))) == ()


def test_a_governor_that_follows_the_load_is_noted():
    one = only(found(host={"governor": "schedutil", "cores": 4}))
    assert (one.effect, "cpupower" in one.remedy) == ("note", True)
    assert validity([one]) == "valid"
    assert findings(found(host={"governor": "performance", "cores": 4})) == ()


def test_the_worst_comes_first():
    seen = findings(
        found(
            switches=5000, host={"governor": "powersave"}, policy={"memory": {"remembers": True, "ratio": 2, "low": 2}}
        )
    )
    assert [each.effect for each in seen] == ["invalid", "suspect", "note"]


def test_the_canary_takes_time_and_drifts_by_halves():
    assert 0 < canary_ms() < 1000
    assert drift([1.0] * 3) == 0.0
    assert drift([1.0, 1.0, 1.0, 1.1, 1.1]) == pytest.approx(0.1)
