"""From what a measurement found to numbers, series and tables."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "telemetry"))

from _runs import QUIET, run_of
from telemetry_boards import AGX_ORIN, NUC, ORIN_NANO, write

from vlatool.measurement.cold_start import ColdStart
from vlatool.measurement.results import PolicyRun
from vlatool.measurement.rows import measurements, raw, sustained_rows, tables
from vlatool.telemetry import Absent, Gauge, Recorder, open_all


def recorded(root, seconds):
    """Return what two samples of a copied tree give, so many seconds apart."""
    now = [1000.0]
    recorder = Recorder(open_all(root), 1e9, clock=lambda: now[0])
    recorder.sample(every=True)
    now[0] += seconds
    recorder.sample(every=True)
    return recorder.summary


def found(telemetry=None, calls=100, **more):
    times = tuple(0.1 * number for number in range(calls))
    policy = PolicyRun("int8", ((2.0,) * 5,) * (calls // 5), times, **more)
    return run_of(policy, ended_s=1020.0, wall_s=20.0, cpu_s=30.0, telemetry=telemetry)


def numbers(what, reference=None, rate=0.0):
    return {each.name: each for each in measurements(what, what.policies[0], reference, rate)}


def test_a_policy_alone_has_throughput_and_processor_use():
    told = numbers(found())
    assert told["throughput"].value == pytest.approx(500)
    assert told["jitter"].value == 0
    assert told["cpu"].value == 1.5
    assert told["latency_p90"].value == 2.0
    assert not told["latency_p99.9"].known
    assert "6,636 independent calls" in told["latency_p99.9"].note
    assert "energy_per_action" not in told


def test_beside_others_it_has_a_speed_up_and_no_refusals():
    what = found()
    slower = PolicyRun("float32", ((6.0,) * 5,) * 20, ())
    told = numbers(what, slower)
    assert told["speedup"].value == 3.0
    assert "latency_p99.9" not in told
    assert "cpu" not in told


@pytest.mark.parametrize("calls", [1, 2, 3, 7, 10])  # of a round; the fewest are too few for a bound of the median
def test_the_speed_up_is_the_quotient_of_the_medians_beside_it(calls):
    for seed in range(20):
        random = np.random.default_rng((seed, calls))  # a machine with two speeds: no call is near the middle
        speeds = np.where(random.random((2, 20, calls)) < 0.5, 1.0, 2.0)
        rounds = (speeds + 0.1 * random.random(speeds.shape)).tolist()
        own, base = (PolicyRun(name, tuple(map(tuple, each)), ()) for name, each in zip("ab", rounds, strict=True))
        what = run_of(own)
        told, reference = ({each.name: each.value for each in measurements(what, one, base, 0)} for one in (own, base))
        assert told["speedup"] == pytest.approx(reference["latency_p50"] / told["latency_p50"], rel=1e-12)


def test_energy_of_a_jetson_is_that_of_its_input_rail(tmp_path):
    telemetry = recorded(write(tmp_path, ORIN_NANO), 20.0)
    told = numbers(found(telemetry))
    watts = told["power_mean"].value
    assert watts == pytest.approx(telemetry.energy[0].mean_w)
    assert watts > 0
    assert told["energy_per_action"].value == pytest.approx(watts * 20.0 / 100)
    assert "VDD_IN" in told["power_mean"].note
    assert "idle power included" in told["energy_per_action"].note
    hottest = max(gauge.max for gauge in telemetry.gauges.values() if gauge.unit == "degC")
    assert told["temperature_max"].value == hottest


def test_without_an_input_rail_the_label_says_what_is_summed(tmp_path):
    assert "module" in numbers(found(recorded(write(tmp_path, AGX_ORIN), 20.0)))["power_mean"].note


def test_a_short_run_has_power_and_no_energy(tmp_path):
    told = numbers(found(recorded(write(tmp_path, ORIN_NANO), 3.0)))
    assert told["power_mean"].known
    assert not told["energy_per_action"].known
    assert "--duration 10" in told["energy_per_action"].note


def test_a_nuc_counts_energy_over_the_wrap_around(tmp_path):
    root = write(tmp_path, NUC)
    now = [0.0]
    recorder = Recorder(open_all(root), 1e9, clock=lambda: now[0])
    package = root / "sys/class/powercap/intel-rapl:0"
    (root / "sys/class/powercap/intel-rapl:1/name").write_text("other")
    wraps = int((package / "max_energy_range_uj").read_text())
    (package / "energy_uj").write_text(str(wraps - 100_000_000))
    recorder.sample(every=True)
    (package / "energy_uj").write_text("140000000")
    now[0] = 20.0
    recorder.sample(every=True)
    told = numbers(found(recorder.summary))
    assert told["power_mean"].value == pytest.approx(240 / 20)
    assert told["energy_per_action"].value == pytest.approx(2.4)


def test_every_sample_and_what_the_board_told_is_kept(tmp_path):
    telemetry = recorded(write(tmp_path, ORIN_NANO), 20.0)
    what = found(telemetry)
    series = raw(what, what.policies[0], alone=True)
    assert len(series["latency_ms"]) == len(series["at_s"]) == 100
    gauges = [name for name in series if name.startswith("telemetry.") and not name.endswith(".at_s")]
    assert gauges
    for name in gauges:
        assert len(series[name]) == len(series[f"{name}.at_s"]) == 2
        assert series[f"{name}.at_s"] == [0.0, 20.0]
    assert set(raw(what, what.policies[0], alone=False)) == {"latency_ms", "at_s"}


def test_throttled_moments_are_kept():
    gauge = Gauge("throttle", 0.0, 0.5, 1.0, (1001.0, 1002.0), (0.0, 1.0), "")
    what = found(replace(QUIET, gauges={"pi.throttled": gauge}))
    assert raw(what, what.policies[0], alone=True)["throttled_at_s"] == [2.0]


def test_what_is_absent_is_told_and_never_zero():
    what = found(replace(QUIET, unmeasured=(Absent("rapl", "no RAPL"),)))
    told = tables(what, what.policies[0], alone=True)
    assert told["unmeasured"] == [{"what": "rapl", "why": "no RAPL"}]
    assert "power_mean" not in numbers(what)


def test_sources_of_other_boards_share_a_line(tmp_path):
    absent = [each for each in open_all(tmp_path) if isinstance(each, Absent) and each.reader != "process"]
    what = found(replace(QUIET, unmeasured=(*absent, Absent("fan", "its file cannot be read"))))
    *own, others = tables(what, what.policies[0], alone=True)["unmeasured"]
    assert own[-1] == {"what": "fan", "why": "its file cannot be read"}
    assert {"ina", "nvpmodel", "rapl", "thermal", "vcgencmd"} <= set(others["what"].split(", "))
    assert not {"ina", "rapl"} & {each["what"] for each in own}


def test_memory_and_cold_start_by_part():
    rss = {"interpreter": 10.0, "imported": 30.0, "engine": 50.0, "loaded": 90.0, "first": 88.0, "more": 100.0}
    start = ColdStart(start_ms=20.0, import_ms=100.0, engine_ms=30.0, load_ms=40.0, first_ms=10.0, total_ms=200.0,
                      peak_rss_mb=101.0, rss_mb=rss)  # fmt: skip
    what = found(cold=(start,) * 3)
    told = tables(what, what.policies[0], alone=True)
    assert [line["MB"] for line in told["memory by part"]] == [10, 20, 20, 40, 0, 10]
    assert sum(line["share %"] for line in told["memory by part"]) == 100
    assert [line["ms"] for line in told["cold start by part"]] == [20, 100, 30, 40, 10]
    measured = numbers(what)
    assert [measured[name].value for name in ("peak_rss", "steady_rss", "cold_start")] == [101, 100, 200]


def test_a_sustained_run_compares_its_end_with_its_start():
    told = {each.name: each.value for each in sustained_rows([1.0] * 500 + [1.5] * 500)}
    assert told == {"latency_start_p50": 1.0, "latency_sustained_p50": 1.5, "sustained_slowdown": 1.5}
    assert not any(math.isnan(value) for value in told.values())
