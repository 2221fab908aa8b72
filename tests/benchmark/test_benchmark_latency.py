"""What is measured is named, counted and comparable; no test asserts a time."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from pydantic import ValidationError

from vlatool.benchmark import latency
from vlatool.benchmark.latency import Latency, processors
from vlatool.bundle.bundle import Bundle, seal
from vlatool.errors import BundleError, ProfileError, UsageError
from vlatool.export.onnx import ExportOnnx
from vlatool.files.messages import from_json, to_json
from vlatool.graph.workload import workload
from vlatool.graph.zeros import zero_share
from vlatool.measurement.cold_start import ColdStart, cold_start, peak_rss_mb, resident_mb, run
from vlatool.measurement.interleaved import BLOCKS, Contestant, latency_measurements, speedup, unique_names
from vlatool.measurement.jobs import ColdStartJob, LatencyJob
from vlatool.report import Measurement, Row
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform


def names(row):
    return {measurement.name for measurement in row.measurements}


@pytest.fixture(scope="module")
def report(float_bundle, int8_bundle):
    stage = Latency(against=(int8_bundle.path,), iterations=20, warmup=1, duration=0, cold=False)
    stage.check(float_bundle, None)
    return stage.run(float_bundle, Context())


def test_one_row_for_each_policy_the_first_is_the_baseline(report):
    assert [(row.name, row.role) for row in report.rows] == [("float32", "baseline"), ("static_int8", "subject")]
    assert (report.kind, report.verdict) == ("benchmark", "info")
    assert "float32" in report.summary[0]
    assert "1 thread" in report.summary[0]
    assert report.environment["cpu"]


def test_every_sample_is_kept_and_counted(report):
    for row in report.rows:
        assert len(row.raw["latency_ms"]) == 20
        assert min(row.raw["latency_ms"]) > 0
        assert row.get("latency_p50").samples == row.get("latency_max").samples == 20
        assert row.value("latency_max") == max(row.raw["latency_ms"])
        assert row.get("latency_p50").unit == "ms"


def test_calls_as_a_robot_makes_them_stand_beside_others(float_bundle):
    stage = Latency(iterations=20, warmup=1, duration=0, cold=False, phase=False, reach=False, duty_cycle=500)
    stage.check(float_bundle, None)
    (row,) = stage.run(float_bundle, Context()).rows
    assert [each["calls"] for each in row.details["latency by the way of calling"]] == [
        "busy loop", "at the robot's rate", "single shots"]  # fmt: skip
    assert row.value("duty_ratio") == pytest.approx(row.value("latency_duty_p50") / row.value("latency_busy_p50"))
    assert row.get("single_ratio").samples == 6
    with pytest.raises(UsageError, match=r"--duty-cycle is nan"):
        Latency.model_construct(**{**dict(stage), "duty_cycle": float("nan")}).check(float_bundle, None)


def test_percentiles_that_twenty_samples_cannot_bound_are_left_out(report):
    for row in report.rows:
        assert "latency_p50" in names(row)
        assert not {"latency_p90", "latency_p99"} & names(row)


def test_the_size_is_that_of_the_graphs(report, float_bundle):
    graph = float_bundle.path / "graphs/main.onnx"
    assert report.rows[0].value("size") == graph.stat().st_size / 1e6


def test_each_row_says_what_an_inference_computes(report, float_bundle, int8_bundle):
    for row, bundle, precision in zip(report.rows, (float_bundle, int8_bundle), ("float32", "int8"), strict=True):
        (table,) = row.details["workload"]
        load = workload(bundle)
        assert table["macs"] == sum(load.macs.values())
        assert table["layers"] == load.layers
        assert (table["precision"], table["engine"]) == (precision, "ort_cpu")
        assert set(table["traits"]) == load.graphs["main"].traits
        assert json.loads(json.dumps(table)) == table
    one, other = (row.details["workload"][0] for row in report.rows)
    assert one["weights"] == other["weights"], "however they are stored"


def test_the_baseline_is_as_fast_as_itself(report):
    assert report.rows[0].value("speedup") == 1.0
    faster = report.rows[1].get("speedup")
    assert faster.low <= faster.value <= faster.high
    assert "interleaved" in faster.note


def test_without_cold_starts_none_is_reported(report):
    assert not {"peak_rss", "cold_start"} & names(report.rows[0])


def test_cold_starts_report_memory_and_time(float_bundle, monkeypatch):
    monkeypatch.setattr(latency, "COLD_STARTS", 3)
    row = Latency(iterations=20, warmup=1, duration=0).run(float_bundle, Context()).rows[0]
    assert row.get("peak_rss").unit == "MB"
    assert row.value("peak_rss") > 10
    assert row.value("cold_start") > 0
    assert row.get("cold_start").samples == 3


def test_a_source_bundle_is_measured_in_eager_torch(float_bundle, source_bundle):
    found = Latency(against=(source_bundle.path,), iterations=20, warmup=1, duration=0, cold=False).run(
        float_bundle, Context()
    )
    row = found.rows[1]
    assert row.name == "torch eager"
    assert "size" not in names(row)
    assert row.get("latency_p50").samples == 20


def test_a_bundle_with_nothing_to_run_is_refused(float_bundle):
    empty = replace(float_bundle.manifest, graphs={}, source={})
    with pytest.raises(BundleError, match="has nothing to run"):
        Latency().run(Bundle(float_bundle.path, empty), Context())


def test_an_unknown_engine_gets_the_nearest_name(float_bundle):
    with pytest.raises(UsageError, match="did you mean 'ort_cpu'"):
        Latency(engine="ort_gpu").run(float_bundle, Context())


def test_the_further_bundles_belong_to_the_key_and_are_opened_first(float_bundle, int8_bundle, tmp_path):
    stage = Latency(against=(int8_bundle.path,))
    assert stage.inputs() == (int8_bundle.path / "manifest.json",)
    assert stage.key("a") != Latency().key("a")
    assert stage.key("a") == stage.key("a") != stage.key("b")
    with pytest.raises(BundleError, match="No bundle"):
        Latency(against=(tmp_path / "none",)).check(float_bundle, None)


def contestant(name, bundle, *blocks):
    return Contestant(name, bundle, policy=None, observations=[], blocks=list(blocks))


def test_contestants_of_one_stage_are_told_apart_by_their_folders(float_bundle, int8_bundle):
    found = [contestant("static_int8", float_bundle), contestant("static_int8", int8_bundle), contestant("x", None)]
    found[1].bundle = Bundle(int8_bundle.path.parent / "other", int8_bundle.manifest)
    unique_names(found)
    assert [each.name for each in found] == ["static_int8 (bundle)", "static_int8 (other)", "x"]


def test_the_speed_up_is_the_ratio_of_the_medians(float_bundle):
    base = contestant("a", float_bundle, *[[2.0, 4.0, 6.0]] * BLOCKS)
    own = contestant("b", float_bundle, *[[1.0, 2.0, 3.0]] * BLOCKS)
    found = speedup(own, base)
    assert (found.value, found.low, found.high, found.samples) == (2.0, 2.0, 2.0, 3 * BLOCKS)


@pytest.mark.parametrize(
    ("count", "wanted"),
    [
        (10, set()),
        (11, {"p50"}),
        (63, {"p50"}),
        (64, {"p50", "p90"}),
        (130, {"p50", "p90", "p95"}),
        (662, {"p50", "p90", "p95", "p99"}),
        (6636, {"p50", "p90", "p95", "p99", "p99.9"}),
    ],
)
def test_a_percentile_needs_enough_samples_for_its_upper_bound(count, wanted):
    samples = np.random.default_rng(count).exponential(size=count)
    found = {each.name: each for each in latency_measurements(samples)}
    assert set(found) == {f"latency_{name}" for name in wanted} | {"latency_p50", "latency_max"}
    assert found["latency_max"].value == samples.max()
    for name in wanted:
        each = found[f"latency_{name}"]
        assert (each.low, each.confidence) == (None, 0.99)
        assert each.value <= each.high
    assert found["latency_p50"].high is not None or count < 11
    refused = {each.name: each for each in latency_measurements(samples, refusals=True) if not each.known}
    assert set(refused) == {f"latency_p{name}" for name in ("90", "95", "99", "99.9")} - set(found)
    assert all("independent calls" in each.note and "--iterations" in each.note for each in refused.values())


# ---- the probe


def probe_of(bundle):
    return ColdStartJob(str(bundle.path), "ort_cpu", 1, time.monotonic_ns())


def test_the_probe_runs_in_a_fresh_process(int8_bundle):
    found = cold_start(int8_bundle.path, "ort_cpu", 1)
    assert all(value > 0 for name, value in vars(found).items() if name != "rss_mb")
    assert list(found.rss_mb) == ["interpreter", "imported", "engine", "loaded", "first", "more"]
    assert 0 < found.rss_mb["interpreter"] < found.rss_mb["loaded"] <= found.peak_rss_mb + 1
    assert found.total_ms > found.start_ms + found.import_ms + found.load_ms


def test_the_probe_prints_one_line_of_json(int8_bundle):
    command = [sys.executable, "-m", "vlatool.measurement.cold_start"]
    line = json.dumps(to_json(probe_of(int8_bundle)))
    done = subprocess.run(command, input=line, capture_output=True, text=True, check=True)
    assert from_json(ColdStart, json.loads(done.stdout)["result"]["value"]).peak_rss_mb > 0


def test_the_probe_says_why_a_bundle_does_not_run(tmp_path):
    with pytest.raises(BundleError, match=r"No bundle at .*none"):
        cold_start(tmp_path / "none", "ort_cpu", 1)


def test_the_probe_in_this_process(float_bundle):
    assert run(probe_of(float_bundle)).first_ms > 0


def test_a_bundle_without_golden_values_is_probed_on_another_observation(float_bundle, copied):
    from vlatool.bundle.bundle import seal

    bare = copied(float_bundle)
    seal(bare.path, replace(bare.manifest, golden=""))
    found = run(probe_of(bare))
    assert "first" in found.rss_mb
    assert found.first_ms > 0


def test_the_peak_of_memory_is_the_processs_own(tmp_path):
    (tmp_path / "status").write_text("Name:\tx\nVmHWM:\t   2000 kB\n")
    assert peak_rss_mb(tmp_path / "status") == 2.048
    (tmp_path / "status").write_text("VmHWM:\t   2000 kB\nVmRSS:\t   1000 kB\n")
    assert resident_mb(tmp_path / "status") == 1.024
    (tmp_path / "status").write_text("Name:\tx\n")
    assert peak_rss_mb(tmp_path / "status") > 1
    assert resident_mb(tmp_path / "status") > 1


# ---- options


def benchmarked(bundle, context=None, **options):
    stage = Latency(**({"iterations": 20, "warmup": 1, "duration": 0, "cold": False, "phase": False} | options))
    stage.check(bundle, None)
    return stage.run(bundle, context or Context())


def test_a_run_alone_says_whether_it_can_be_trusted_and_keeps_what_it_saw(float_bundle):
    report = benchmarked(float_bundle, phase=True)
    assert report.validity in ("valid", "suspect")
    row = report.rows[0]
    assert {"throughput", "jitter", "cpu", "size"} <= names(row)
    assert len(row.raw["at_s"]) == len(row.raw["latency_ms"]) == 20
    assert {"engine", "time by phase", "telemetry", "workload"} <= set(row.details)
    assert row.details["engine"][0]["providers"] == "CPUExecutionProvider"


def test_a_paced_run_has_misses_and_its_rate_as_the_limit(float_bundle):
    report = benchmarked(float_bundle, rate=200.0)
    assert report.limits == {"hz": 200.0}
    assert {"deadline_misses", "age_p50", "wakeup_p99", "jitter"} <= names(report.rows[0])
    assert "throughput" not in names(report.rows[0])
    assert "at 200 Hz" in report.summary[0]
    assert "from the moment at which the tick was due" in report.rows[0].get("latency_p50").note


def test_a_sustained_run_lasts_and_compares(float_bundle):
    report = benchmarked(float_bundle, sustained=0.3, answers=False)
    assert report.rows[0].get("sustained_slowdown").unit == "x"
    assert sum(report.rows[0].raw["latency_ms"]) / 1e3 < 5
    assert report.rows[0].raw["at_s"][-1] > 0.2


def test_an_invalid_measurement_decides_nothing(float_bundle, monkeypatch):
    from vlatool.measurement import agent

    honest = agent.measure

    def strays(job, tell):
        found = honest(job, tell)
        policy = found.policies[0]
        return replace(found, policies=(replace(policy, answers=replace(policy.answers, strays=7)),))

    monkeypatch.setattr(agent, "measure", strays)
    report = benchmarked(float_bundle)
    assert (report.verdict, report.validity) == ("inconclusive", "invalid")
    assert "The measurement is invalid" in report.summary[0]


def test_a_board_is_emulated_with_its_processors_and_memory(float_bundle):
    from vlatool.hardware.profile import load_profile

    board = load_profile("raspberry-pi-5")
    stage = Latency(emulate=True, iterations=20, duration=0, cold=False, threads=1)
    stage.check(float_bundle, board)
    limited = stage.on(board)
    assert (limited.cores, limited.memory_mb) == (4, 1e3 * board.usable_memory_gb.value)
    report = limited.run(float_bundle, Context())
    notes = [each for each in report.findings if "emulation" in each.reason]
    assert notes
    assert notes[0].effect == "note"
    assert "raspberry-pi-5" in notes[0].reason
    assert report.rows[0].measurements[0].where == "this host, limited as raspberry-pi-5"
    with pytest.raises(UsageError, match="--threads is 9; raspberry-pi-5 has 4 processors"):
        stage.model_copy(update={"threads": 9}).on(board)
    with pytest.raises(ProfileError, match="no power mode 'turbo'"):
        stage.model_copy(update={"mode": "turbo"}).on(board)
    assert Latency().on(board) == Latency()


def test_a_job_runs_elsewhere_where_the_context_says_so(float_bundle):
    from vlatool.measurement.agent import measure

    asked = []

    def elsewhere(job, bundles, tell):
        asked.append((job, bundles))
        return {**to_json(measure(from_json(LatencyJob, job), tell)), "target": {"python": "3.10"}}

    report = benchmarked(float_bundle, Context(measure_remotely=elsewhere))
    assert asked[0][1] == [float_bundle.path]
    assert report.environment["target"] == {"python": "3.10"}
    assert report.rows[0].measurements[0].where != "this host"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"rate": 10, "against": ["x"]}, "--rate paces one policy"),
        ({"rate": 10, "sustained": 5}, "--sustained calls back to back"),
        ({"emulate": True}, "--emulate needs a board"),
        ({"mode": "15W"}, "--mode is the power mode that --emulate takes"),
        ({"pin": "a-b"}, "--pin is 'a-b'"),
        ({"pin": "3-1"}, "names no processor"),
        ({"rate": 1e-6}, "more than a day"),
        ({"rate": 0.001, "iterations": 500}, "more than a day"),
    ],
)
def test_options_that_make_no_sense_are_refused(float_bundle, options, told):
    with pytest.raises(UsageError, match=told):
        Latency(**options).check(float_bundle, None)


@pytest.mark.parametrize(("text", "wanted"), [("", ()), ("0", (0,)), ("0-2,5", (0, 1, 2, 5)), ("3,3,1", (1, 3))])
def test_processors_are_read_as_lists_of_ranges(text, wanted):
    assert processors(text) == wanted


def test_what_the_engine_logs_is_kept(float_bundle):
    from vlatool.measurement.agent import measure

    def elsewhere(job, bundles, tell):
        log = "".join(f"warning {number}\n" for number in range(50))
        return {**to_json(measure(from_json(LatencyJob, job), tell)), "log": log}

    lines = benchmarked(float_bundle, Context(measure_remotely=elsewhere)).rows[0].details["log"]
    assert [line["line"] for line in lines] == [f"warning {number}" for number in range(10, 50)]
    assert "log" not in benchmarked(float_bundle).rows[0].details


def test_the_memory_of_eager_torch_is_not_said_to_be_limited(float_bundle, source_bundle):
    with pytest.raises(UsageError, match="memory of eager torch is not limited"):
        benchmarked(float_bundle, against=(source_bundle.path,), memory_mb=5000)


@pytest.mark.parametrize("options", [{"threads": 2000}, {"memory_mb": 1e300}, {"cores": 10**20}, {"duration": 1e6}])
def test_numbers_that_no_machine_has_are_refused(options):
    with pytest.raises(ValidationError, match="less than or equal"):
        Latency(**options)


def test_zeros_are_said_to_gain_nothing_as_measured(source_bundle: Bundle, float_bundle: Bundle, tmp_path: Path):
    sparse = run_transform(
        build_stage("prune.magnitude", {"ratio": 0.8}), source_bundle, tmp_path / "sparse", Context()
    ).bundle
    exported = run_transform(ExportOnnx(), sparse, tmp_path / "exported", Context()).bundle
    assert zero_share(float_bundle) == 0
    assert 0.5 < zero_share(exported) < 0.8, "what is protected is dense"
    report = benchmarked(float_bundle, against=(exported.path,))
    reasons = [finding.reason for finding in report.findings if "zero" in finding.reason]
    assert len(reasons) == 1
    speedup = report.rows[1].value("speedup")
    assert f"are zero, and it is {speedup:.3g}x as fast as " in reasons[0]
    assert "ONNX Runtime " in reasons[0]
    back = benchmarked(exported, against=(float_bundle.path,))
    assert not [finding for finding in back.findings if "zero" in finding.reason]


@pytest.mark.parametrize(("share", "effects"), [(0.9, []), (1.2, []), (2.2, ["note"]), (23_430.0, ["suspect"])])
def test_a_speed_that_no_kernel_has_is_told(share: float, effects: list[str]):
    found = list(latency._beyond([Row("mine", "subject", "", (Measurement("reach_share", share, "1"),))]))
    assert [each.effect for each in found] == effects
    assert all("mine seems to do its work" in each.reason and each.remedy for each in found)


def test_work_that_the_engine_leaves_out_is_told(tmp_path: Path, float_bundle: Bundle):
    made = copied_with_a_constant_product(float_bundle, tmp_path / "made")
    report = Latency(iterations=20, warmup=1, duration=0, cold=False).run(made, Context())
    assert report.validity == "suspect"
    assert any("leaves out most of what the graph counts" in each.reason for each in report.findings)


def copied_with_a_constant_product(bundle: Bundle, place: Path) -> Bundle:
    """A bundle with a large product of two constants that nothing reads."""
    shutil.copytree(bundle.path, place)
    file = place / "graphs/main.onnx"
    model = onnx.load(file)
    large = np.full((1024, 1024), 0.5, np.float32)
    model.graph.initializer.append(onnx.numpy_helper.from_array(large, "large"))
    model.graph.node.append(onnx.helper.make_node("MatMul", ["large", "large"], ["unread"]))
    onnx.save(model, file)
    return seal(place, bundle.manifest)
