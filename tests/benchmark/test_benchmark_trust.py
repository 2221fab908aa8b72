"""What is seen beside the latencies decides whether they can be trusted."""

import pytest

from vlatool.benchmark._canary import canary_ms, drift
from vlatool.benchmark._trust import findings, validity


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
    assert validity([one]) == "invalid"


def test_answers_from_memory_are_invalid():
    memory = {"ratio": 3.0, "low": 2.5, "pairs": 40, "remembers": True}
    assert only(found(policy={"memory": memory})).effect == "invalid"
    assert findings(found(policy={"memory": memory | {"remembers": False}})) == ()


def test_a_busy_host_is_suspect():
    assert findings(found(host={"load_average": [0.5, 9, 9], "cores": 2})) == ()
    assert findings(found(host={"load_average": None, "cores": 2})) == ()
    assert "load 6.0 on 2 cores" in only(found(host={"load_average": [6.0, 0, 0], "cores": 2})).reason


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
    assert "10% slower" in only(found(policy={"blocks_ms": blocks})).reason
    assert findings(found(policy={"blocks_ms": blocks}), duration_is_sustained=True) == ()
    assert findings(found(policy={"blocks_ms": [[1.0]] * 15 + [[2.0]] * 5})) == (), "too few to say"


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
