"""The commands that choose, simulate and describe boards, as a person types them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.cli import main
from vlatool.hardware.profile import load_profile, profile_names
from vlatool.report import Report, read_report

SMALL = ["--boards", "raspberry-pi-5", "--boards", "jetson-orin-nano", "--boards", "raspberry-pi-5-hailo8"]


def strict(text: str):
    """Read JSON that has no NaN in it."""

    def refuse(name: str):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(autouse=True)
def _no_calibration(monkeypatch, tmp_path):
    monkeypatch.setenv("VLATOOL_CALIBRATIONS", str(tmp_path / "kept"))


# ---- hwselect


@pytest.mark.parametrize(
    "line",
    [["hwselect"], ["hwselect", "select"], ["hwselect", "score"], ["hwselect", "fit"], ["simulate"],
     ["profiles", "diff"], ["profiles", "validate"], ["profiles", "new"], ["profiles", "calibrate"]],
    ids=" ".join,
)  # fmt: skip
def test_every_command_has_help(vlatool, line):
    code, out, _ = vlatool(*line, "--help")
    assert code == 0
    assert out.startswith("Usage:")


def test_hwselect_ranks_boards_and_says_what_comes_next(vlatool, policy_template):
    code, out, err = vlatool("hwselect", policy_template, *SMALL, "--hz", 10)
    assert code == 0, err
    assert out.startswith("PASS  raspberry-pi-5 is the cheapest of ")
    assert f"vlatool optimize {policy_template} --profile raspberry-pi-5 --hz 10" in " ".join(out.split())
    assert "Fits: PREDICTED, not measured" in out
    assert "times as fast as needed" in out
    assert "predicting" in err


@pytest.mark.parametrize("kind", ["policy_template"])
def test_the_command_that_comes_next_can_be_typed(vlatool, kind, request, tmp_path, monkeypatch):
    source = request.getfixturevalue(kind)
    monkeypatch.chdir(tmp_path)
    out = vlatool("hwselect", getattr(source, "path", source), *SMALL, "--hz", 10, "--json")[1]
    (following,) = [told for told in Report.from_json(out).summary if told.startswith("Next: vlatool ")]
    code, _, err = vlatool(*shlex.split(following.removeprefix("Next: vlatool ")), "--dry-run")
    assert code == 0, err


def test_hwselect_looks_at_every_board_when_none_is_named(vlatool, float_bundle):
    code, out, _ = vlatool("hwselect", float_bundle.path, "--json")
    assert code == 0
    report = Report.from_json(out)
    owned = {name for name in profile_names() if load_profile(name).price_usd_per_hour is None}
    assert {row.name for row in report.rows} == owned
    assert report.limits == {"hz": 10.0}, "the control rate of the policy"


def test_hwselect_json_is_a_report_whose_rows_are_predictions(vlatool, float_bundle):
    code, out, _ = vlatool("hwselect", float_bundle.path, *SMALL, "--latency-ms", 50, "--battery-wh", 100, "--json")
    assert code == 0
    strict(out)
    report = Report.from_json(out)
    assert (report.kind, report.verdict) == ("hwselect", "pass")
    assert report.limits == {"latency_ms": 50.0}
    assert [row.role for row in report.rows].count("chosen") == 1
    for row in report.rows:
        assert row.measurements
        assert {item.origin for item in row.measurements} == {"predicted"}
        assert row.reason
        (way,) = row.details["way"]
        assert way["state"] in ("fits", "may fit", "unknown", "no")
        if way["state"] == "fits":
            got = {item.name: item for item in row.measurements}
            assert got["latency_p50"].high <= 50
            assert got["memory"].high < got["usable_memory"].value
            assert {"watts", "energy", "battery_life", "average_watts", "owned_cost"} <= {*got}
            assert got["battery_life"].value == pytest.approx(100 / got["average_watts"].value)


def test_hwselect_writes_three_reports(vlatool, float_bundle, tmp_path):
    out = tmp_path / "report"
    code, told, _ = vlatool("hwselect", float_bundle.path, *SMALL, "-o", out)
    assert code == 0
    assert {path.name for path in out.glob("[!.]*")} == {"report.json", "report.html", "report.md"}
    assert told.endswith(f"report: {out / 'report.html'}\n")
    assert read_report(out).kind == "hwselect"
    assert "raspberry-pi-5" in (out / "report.html").read_text()
    assert "raspberry-pi-5" in (out / "report.md").read_text()
    assert vlatool("hwselect", float_bundle.path, *SMALL, "-o", out)[0] == 3
    assert vlatool("hwselect", float_bundle.path, *SMALL, "-o", out, "--force")[0] == 0


def test_hwselect_takes_a_policy_that_was_never_exported(vlatool, policy_template, float_bundle):
    def found(source):
        _, out, _ = vlatool("hwselect", source, *SMALL, "--hz", 10, "--json")
        return {row.name: [(item.name, item.value) for item in row.measurements if item.name == "latency_p50"]
                for row in Report.from_json(out).rows}  # fmt: skip

    assert found(policy_template) == found(float_bundle.path)


def test_hwselect_counts_a_policy_once(vlatool, policy_dir):
    (policy_dir / "policy.yaml").write_text((policy_dir / "policy.yaml").read_text().replace("tiny", "other"))
    assert "counting the policy's work" in vlatool("hwselect", policy_dir, *SMALL)[2]
    assert "counting the policy's work" not in vlatool("hwselect", policy_dir, *SMALL)[2]


def test_hwselect_writes_the_count_that_a_policy_carries(vlatool, policy_dir):
    code, out, err = vlatool("hwselect", policy_dir, "--boards", "raspberry-pi-5", "--carry-count", "--json")
    assert code == 0
    assert f"count kept in {policy_dir / 'workload.json'}" in err
    assert strict(out)["kind"] == "hwselect"


def test_flags_may_come_before_the_source(vlatool, float_bundle):
    assert vlatool("hwselect", "--hz", 10, *SMALL, float_bundle.path)[0] == 0


def test_hwselect_on_a_quantized_bundle_takes_it_as_it_is(vlatool, int8_bundle):
    report = Report.from_json(vlatool("hwselect", int8_bundle.path, *SMALL, "--json")[1])
    assert {row.details["way"][0].get("precision", "") for row in report.rows} == {""}
    assert "fit:  with" not in report.summary[0], "its precision has a name"


def test_when_no_board_will_do_the_exit_code_is_1_and_each_says_why(vlatool, float_bundle):
    code, out, err = vlatool("hwselect", float_bundle.path, *SMALL, "--max-price", 1)
    assert code == 1
    assert out.startswith("FAIL")
    assert "costs 399 dollars, more than 1" in " ".join(out.split())
    error, fix = err.splitlines()[-2:]
    assert error.startswith("error: No board is certain to run")
    assert fix.startswith("  fix: change the policy, the options or the limit")


def test_a_platform_gives_rate_and_watts_where_they_are_not_given(vlatool, float_bundle):
    line = ["hwselect", float_bundle.path, "--json", *SMALL]
    assert Report.from_json(vlatool(*line, "--platform", "quadcopter")[1]).limits["max_watts"] == 15
    limits = Report.from_json(vlatool(*line, "--platform", "arm", "--hz", 7, "--max-watts", 26)[1]).limits
    assert (limits["hz"], limits["max_watts"]) == (7, 26)
    limits = Report.from_json(vlatool(*line, "--platform", "arm", "--latency-ms", 70)[1]).limits
    assert (limits["latency_ms"], "hz" in limits) == (70, False)


def test_a_rented_machine_is_compared_when_asked_for(vlatool, float_bundle, monkeypatch):
    line = ["hwselect", float_bundle.path, "--hz", 10, "--json", *SMALL]
    alone = Report.from_json(vlatool(*line)[1])
    assert not any(row.get("cloud_cost", "predicted") for row in alone.rows)
    boards = [*SMALL, "--boards", "h100-80gb", "--boards", "a100-80gb"]
    code, out, _ = vlatool("hwselect", float_bundle.path, "--hz", 10, "--json", *boards, "--cloud")
    assert code == 0
    report = Report.from_json(out)
    assert {row.name for row in report.rows} == {row.name for row in alone.rows}, "it is no board to buy"
    first = report.rows[0]
    cloud, owned = first.get("cloud_cost", "predicted"), first.get("owned_cost", "predicted")
    assert cloud is not None
    assert cloud.value > 0
    assert owned.value > 80


def test_more_robots_cost_more(vlatool, float_bundle):
    def owned(count: int) -> float:
        out = vlatool("hwselect", float_bundle.path, *SMALL, "--robots", count, "--json")[1]
        return Report.from_json(out).rows[0].get("owned_cost", "predicted").value

    assert owned(10) == pytest.approx(10 * owned(1))


# ---- score and fit


def test_score_tells_error_and_coverage(vlatool, points_file):
    code, out, err = vlatool("hwselect", "score", points_file)
    assert (code, err) == (0, "")
    assert "shipped model" in out.splitlines()[0]
    assert "of 60 rows predicted" in out.splitlines()[1]
    assert [line.split()[0] for line in out.splitlines()[3:6]] == ["all", "cpu", "gpu"]


def test_score_prints_json(vlatool, points_file):
    found = strict(vlatool("hwselect", "score", points_file, "--json")[1])
    assert found["rows"] == 60
    assert found["groups"]["cpu"]["rows"] == 24


@pytest.mark.parametrize("held_out", ["models", "devices", "calibrated"])
def test_a_held_out_score_is_the_same_each_time(vlatool, points_file, held_out):
    line = ["hwselect", "score", points_file, "--held-out", held_out, "--seed", 1]
    code, first, err = vlatool(*line)
    assert (code, err) == (0, "")
    assert vlatool(*line)[1] == first
    found = strict(vlatool(*line, "--json")[1])
    assert found["predicted"] > 0


def test_a_score_can_fit_everything_anew(vlatool, published, points_at):
    path = points_at([row for row in published if row["device"] in ("raspberry-pi-4", "rk3588")])
    line = ["hwselect", "score", path, "--held-out", "devices", "--refit", 0]
    code, out, err = vlatool(*line)
    assert code == 0, err
    heads = [row for row in out.splitlines() if "all fitted anew without it, 0 s each" in row]
    assert [head.split(";")[0] for head in heads] == [
        "each device left out whole", "each device left out but for one model, 5 times, chosen with seed 0",
    ]  # fmt: skip
    assert "1 of 2 parts left out" in err
    found = strict(vlatool(*line, "--json")[1])
    assert {kind: each["predicted"] > 0 for kind, each in found.items()} == {"devices": True, "calibrated": True}


def test_fit_writes_the_model_and_says_so(vlatool, points_file, tmp_path):
    code, out, err = vlatool("hwselect", "fit", points_file, "-o", tmp_path / "made", "--seconds", 0)
    assert (code, out) == (0, ""), err
    assert err.splitlines()[0] == "processors: 42 figures of 7 devices and 6 models"
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"latency.npz", "latency.json"}
    about = json.loads((tmp_path / "made/latency.json").read_text())
    assert about["about"]["figures"] == 60
    assert set(about["parts"]) == {"processors", "npu"}
    with np.load(tmp_path / "made/latency.npz") as stored:
        assert len(stored["processors.logs"]) == 42
        assert stored["npu.keys"].shape == (18, 11)


# ---- simulate


def test_simulate_shows_where_the_time_goes(vlatool, float_bundle):
    code, out, _ = vlatool("simulate", float_bundle.path, "--profile", "raspberry-pi-5")
    assert code == 0
    lines = out.splitlines()
    assert lines[0] == "PREDICTED for raspberry-pi-5, default, ort_cpu, float32; nothing was run there"
    assert "ms an inference (80 %: " in lines[1]
    assert lines[2].startswith("each of the 2 actions that are executed of it: ")
    assert "at the policy's 10 Hz busy " in lines[2]
    assert any(line.startswith("main ") and "█" in line for line in lines)
    assert any(line.startswith("  int8 in the place of float32: ") for line in lines)
    assert any("30 % of each layer pruned" in line for line in lines)
    (parts,) = [line for line in lines if line.startswith("  main: ")]
    assert {word.split()[0] for word in parts.removeprefix("  main: ").split(", ")} == {"vision", "head", "other"}


@pytest.mark.parametrize(
    ("board", "settings"),
    [("raspberry-pi-5", []), ("jetson-orin-nano", ["--mode", "15W", "--precision", "float16"]),
     ("jetson-orin-nano", ["--engine", "ort_cpu", "--precision", "int8"]), ("intel-nuc-13-pro", [])],
)  # fmt: skip
def test_simulate_prints_json(vlatool, float_bundle, board, settings):
    code, out, err = vlatool("simulate", float_bundle.path, "--profile", board, "--json", *settings)
    if code == 3:
        assert "leave a factor of" in err, "too far from what was published"
        return
    found = strict(out)
    assert found["origin"] == "predicted"
    middle, low, high = found["latency_ms"]
    assert 0 < low <= middle <= high
    assert (found["execute"], found["control_hz"]) == (2, 10)
    assert found["joules"] == pytest.approx(found["watts"][0] * middle / 1e3)
    assert sum(phase["ms"] for phase in found["phases"]) == pytest.approx(middle)
    for phase in found["phases"]:
        assert sum(phase["shares"].values()) == pytest.approx(1)
        assert sum(phase["parts"].values()) == pytest.approx(1)
    for change in found["changes"]:
        assert (change["latency_ms"] is None) == bool(change["why"])


def test_simulate_says_the_precision_of_a_bundle(vlatool, int8_bundle):
    out = vlatool("simulate", int8_bundle.path, "--profile", "raspberry-pi-5")[1]
    assert out.startswith("PREDICTED for raspberry-pi-5, default, ort_cpu, int8;")
    assert "in the place of" not in out


# ---- profiles


def test_two_profiles_differ_in_these_fields(vlatool):
    code, out, _ = vlatool("profiles", "diff", "raspberry-pi-4", "raspberry-pi-5")
    assert code == 0
    line = next(line for line in out.splitlines() if line.startswith("bandwidth_gb_s"))
    assert line.split()[1:] == ["12.8", "17.1"]
    _, out, _ = vlatool("profiles", "diff", "raspberry-pi-4", "raspberry-pi-5", "--json")
    found = {each["field"]: each for each in strict(out)}
    assert found["bandwidth_gb_s"] == {"field": "bandwidth_gb_s", "raspberry-pi-4": 12.8, "raspberry-pi-5": 17.1}
    assert "units.cpu.cores" not in found, "both have four"
    assert found["units.cpu.peak_tops.float16"]["raspberry-pi-4"] is None


def test_a_profile_does_not_differ_from_itself(vlatool):
    assert vlatool("profiles", "diff", "raspberry-pi-5", "raspberry-pi-5")[1] == "no difference\n"
    assert vlatool("profiles", "diff", "raspberry-pi-5", "raspberry-pi-5", "--json")[1] == "[]\n"


def test_profiles_are_validated_by_name_file_and_directory(vlatool):
    folder = Path(__file__).parents[2] / "profiles"
    code, out, err = vlatool("profiles", "validate", "raspberry-pi-5", folder / "jetson-nano.yaml", folder)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[:2] == ["ok  raspberry-pi-5", "ok  jetson-nano"]
    assert sorted(lines[2:]) == [f"ok  {name}" for name in profile_names()]


def test_what_is_wrong_in_several_profiles_is_listed_at_once(vlatool, tmp_path):
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(f"name: {name}\n")
    code, out, err = vlatool("profiles", "validate", tmp_path, "raspberry-pi-5")
    assert code == 3
    assert out == "ok  raspberry-pi-5\n"
    assert err.count("is malformed") == 2
    assert err.count("\n  memory_gb: is missing") == 2


def test_a_new_profile_is_a_sound_copy_that_is_found_by_name(vlatool, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = vlatool("profiles", "new", "robot-arm", "--from", "jetson-orin-nano")
    assert code == 0
    assert "vlatool profiles validate robot-arm.yaml" in out
    assert vlatool("profiles", "validate", "robot-arm.yaml")[1] == "ok  robot-arm\n"
    monkeypatch.setenv("VLATOOL_PROFILES", str(tmp_path))
    assert "name " in vlatool("profiles", "diff", "robot-arm", "jetson-orin-nano")[1]
    assert vlatool("profiles", "new", "other", "-o", tmp_path / "robot-arm.yaml", "--force")[0] == 0
    assert (tmp_path / "robot-arm.yaml").read_text().count("name: other") == 1


def test_a_measurement_changes_what_is_predicted_for_its_board(vlatool, float_bundle, tmp_path):
    def predicted(*more):
        line = ["hwselect", float_bundle.path, "--boards", "raspberry-pi-5", "--precision", "float32", "--json"]
        return Report.from_json(vlatool(*line, *more)[1]).rows[0].get("latency_p50", "predicted")

    before = predicted()
    fast = ["--duration", 0, "--iterations", 20, "--no-cold"]
    assert vlatool("benchmark", float_bundle.path, *fast, "-o", tmp_path / "report")[0] == 0
    measured = read_report(tmp_path / "report").rows[0].value("latency_p50")
    code, out, _ = vlatool("profiles", "calibrate", "raspberry-pi-5", "--from", tmp_path / "report")
    assert code == 0
    assert out.splitlines()[0] == f"raspberry-pi-5, default, ort_cpu, float32: {measured:.4g} ms measured"
    kept = tmp_path / "kept/raspberry-pi-5.json"
    assert f"kept in {kept}" in out
    after = predicted()
    assert "with your own measurement" in after.note
    assert abs(np.log(after.value / measured)) < abs(np.log(before.value / measured))
    moved = kept.rename(tmp_path / "elsewhere.json")
    assert predicted().note == before.note
    assert predicted("--calibration", moved).value == after.value


def test_a_report_is_no_calibration_before_it_is_told(vlatool, float_bundle, tmp_path):
    fast = ["--duration", 0, "--iterations", 20, "--no-cold"]
    assert vlatool("benchmark", float_bundle.path, *fast, "-o", tmp_path / "report")[0] == 0
    assert "file that `vlatool profiles calibrate` stored" in " ".join(
        vlatool("hwselect", "select", "--help")[1].split()
    )
    line = ["hwselect", float_bundle.path, "--boards", "raspberry-pi-5"]
    code, _, err = vlatool(*line, "--calibration", tmp_path / "report/report.json")
    assert code == 3
    assert "vlatool profiles calibrate" in err


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (["--max-price", 1], "costs 80 dollars, more than 1"),
        (["--max-watts", 1], "takes up to"),
        (["--memory", 0.001], "0.0 usable"),
        (["--hz", 1e6], "even at"),
        (["--precision", "float8"], "it has no engine for float8"),
    ],
    ids=lambda value: str(value[0]) if isinstance(value, list) else "",
)
def test_what_no_board_can_do_is_answered_with_reasons(flags: list[Any], reason: str, float_bundle, capsys):
    with pytest.raises(SystemExit) as caught:
        main([str(part) for part in ("hwselect", float_bundle.path, "--boards", "raspberry-pi-5", *flags, "--json")])
    assert caught.value.code == 1
    (row,) = Report.from_json(capsys.readouterr().out).rows
    assert row.role == "outside"
    assert reason in row.reason
