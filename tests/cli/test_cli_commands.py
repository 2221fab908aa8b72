"""The commands as a person types them: what is on stdout, what is on stderr, and the exit status."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from _arithmetic import weights_of_this_host

from vlatool import __version__, cli, registry
from vlatool.bundle.bundle import Bundle, seal
from vlatool.cli import main, new
from vlatool.cli._console import command_line, progress, raise_verdict
from vlatool.cli._stages import DEFAULTS
from vlatool.cli.optimize import share
from vlatool.errors import GateFailed, GraphError, Inconclusive, UsageError
from vlatool.files.npz import open_npz
from vlatool.hardware.profile import profile_names
from vlatool.module.description import read_description
from vlatool.report import Measurement, Report, Row, read_report
from vlatool.runtime import load
from vlatool.runtime.identity import policy_identity
from vlatool.stage.base import Context
from vlatool.stage.finish import save_npz

FAST = ["--iterations", "20", "--duration", "0", "--no-cold"]


def process(*line: Any, **settings: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, line)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **settings)


# ---- the program


def test_both_ways_of_starting_the_program():
    for module in ("vlatool", "vlatool.cli"):
        done = process("-m", module, "--version")
        assert (done.returncode, done.stdout, done.stderr) == (0, f"vlatool {__version__}\n", "")


@pytest.mark.parametrize(
    "line",
    [
        [],
        ["optimize"],
        ["export"],
        ["quantize"],
        ["benchmark"],
        ["evaluate"],
        ["compare"],
        ["inspect"],
        ["doctor"],
        ["profiles"],
        ["profiles", "list"],
        ["profiles", "show"],
        ["samples"],
        ["samples", "list"],
        ["samples", "make"],
    ],
    ids=" ".join,
)
def test_every_command_has_help(vlatool, line):
    code, out, _ = vlatool(*line, "--help")
    assert code == 0
    assert out.startswith("Usage:")


@pytest.mark.parametrize("kind", DEFAULTS)
def test_every_method_is_a_command_whose_flags_are_its_fields(vlatool, kind):
    _, listed, _ = vlatool(kind, "--help")
    for entry in registry.names(kind):
        name = entry.replace("_", "-")
        assert name in listed
        code, out, _ = vlatool(kind, name, "--help")
        assert code == 0
        for field in registry.load(kind, entry).model_fields:
            assert f"--{field.replace('_', '-')}" in out


def test_without_a_command_the_help_is_shown(vlatool):
    code, out, err = vlatool()
    assert code == 2
    assert "optimize" in out + err


def test_a_closed_pipe_is_no_error():
    process = subprocess.Popen(
        [sys.executable, "-m", "vlatool", "profiles", "show", "raspberry-pi-5"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    process.stdout.close()
    told = process.stderr.read()
    process.stderr.close()
    assert process.wait() == 0
    assert "Traceback" not in told
    assert "internal error" not in told
    assert "BrokenPipe" not in told


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (MemoryError(), 3, "out of memory"),
        (RuntimeError("odd"), 70, "internal error: RuntimeError: odd"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_what_escapes_a_command_becomes_a_sentence(monkeypatch, capsys, error, code, says):
    def fails(*_arguments, **_settings):
        raise error

    monkeypatch.delenv("VLATOOL_DEBUG", raising=False)
    monkeypatch.setattr(cli, "app", fails)
    with pytest.raises(SystemExit) as left:
        main([])
    assert left.value.code == code
    told = capsys.readouterr().err
    assert says in told
    assert "Traceback" not in told


def test_a_bug_shows_its_traceback_when_asked(monkeypatch):
    def fails(*_arguments, **_settings):
        raise RuntimeError("odd")

    monkeypatch.setenv("VLATOOL_DEBUG", "1")
    monkeypatch.setattr(cli, "app", fails)
    with pytest.raises(RuntimeError, match="odd"):
        main([])


# ---- bundles


def test_quantize_means_static_int8_and_tells_what_it_made(vlatool, float_bundle, tmp_path):
    code, out, err = vlatool("quantize", float_bundle.path, "-o", tmp_path / "out", "--samples", 8)
    assert code == 0
    assert out.splitlines()[0].startswith(f"{tmp_path / 'out'}: tiny 1.2.0, ")
    assert "int8" in out.splitlines()[-2]
    assert "... calibrating on sample" in err
    made = Bundle.open(tmp_path / "out").manifest.made_by
    assert (made["stage"], made["options"]) == ("quantize.static_int8", {"samples": 8, **weights_of_this_host()})


def test_a_method_may_be_named_with_hyphen_or_underscore_and_prints_json(vlatool, float_bundle, tmp_path):
    for number, name in enumerate(("dynamic-int8", "dynamic_int8")):
        target = tmp_path / str(number)
        code, out, _ = vlatool("quantize", name, float_bundle.path, "-o", target, "--no-per-channel", "--json")
        assert code == 0
        made = Bundle.open(target)
        document = json.loads(out)
        difference = document.pop("difference")
        assert 0 < difference.pop("mean") <= difference.pop("worst") < 0.2
        assert difference == {"samples": 24, "recorded": True}
        assert document == {
            "bundle": str(target),
            "hash": made.hash,
            "bytes": made.size_bytes,
            "precision": {"main": made.manifest.graphs["main"].precision},
            "findings": [],
            "board": None,
            "pruned": None,
        }
        assert made.manifest.made_by["options"] == {"per_channel": False, **weights_of_this_host()}


def test_quantize_ends_with_the_error_of_the_action(vlatool, float_bundle, tmp_path):
    out = vlatool("quantize", "dynamic-int8", float_bundle.path, "-o", tmp_path / "o")[1]
    assert re.search(r"\n  action: error against float32 [\d.]+% on average, [\d.]+% at worst \(\d+ recorded obs", out)


def test_flags_may_come_before_the_source_and_be_repeated(vlatool, float_bundle, tmp_path):
    line = ["quantize", "--exclude", "head*", "--exclude", "vision", float_bundle.path, "-o", tmp_path / "o"]
    assert vlatool(*line)[0] == 0
    wanted = {"exclude": ["head*", "vision"], **weights_of_this_host()}
    assert Bundle.open(tmp_path / "o").manifest.made_by["options"] == wanted


def test_an_onnx_file_is_quantized_without_an_export(vlatool, onnx_file, policy_dir, tmp_path):
    shutil.move(onnx_file, policy_dir / "tiny.onnx")
    assert vlatool("quantize", policy_dir / "tiny.onnx", "-o", tmp_path / "out")[0] == 0
    assert Bundle.open(tmp_path / "out").manifest.name == "tiny"


def test_an_onnx_file_is_exported_to_a_bundle(vlatool, onnx_file, policy_dir, tmp_path):
    shutil.move(onnx_file, policy_dir / "tiny.onnx")
    code, _, err = vlatool("export", policy_dir / "tiny.onnx", "-o", tmp_path / "out")
    assert code == 0, err
    assert list(Bundle.open(tmp_path / "out").manifest.graphs) == ["main"]


def test_export_makes_a_bundle_from_a_policy(vlatool, policy_template, float_bundle, tmp_path):
    code, out, _ = vlatool("export", policy_template, "-o", tmp_path / "out")
    assert code == 0
    assert "100.0% float32 of the MACs" in out
    graph = "graphs/main.onnx"
    assert f" 1.2.0, graphs {float_bundle.manifest.files[graph].bytes / 1e6:.2f} MB, in all " in out
    assert (tmp_path / "out" / graph).read_bytes() == (float_bundle.path / graph).read_bytes()


def test_inspect_verifies_and_describes(vlatool, int8_bundle):
    code, out, err = vlatool("inspect", int8_bundle.path)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith(f"tiny 1.2.0  {int8_bundle.hash[:19]}")
    assert "every file verified" in lines[0]
    assert "  A policy that is as small as a policy can be." in lines
    assert f"  policy     {policy_identity(int8_bundle)}" in lines
    text = "\n".join(lines)
    assert "10 Hz control, 2 of 4 actions executed: 5 inferences per second" in text
    assert "input      image: uint8 1x8x8x3 [rgb]" in text
    assert "input      proprio: float32 1x3 [m x2, rad] mean_std" in text
    assert "input      instruction: text -> int64 1x4" in text
    assert "output     action: float32 1x4x2 (dx, dy) [m] delta mean_std" in text
    assert "graph      main: " in text
    assert "made by    quantize.static_int8" in text
    assert f"parent     {int8_bundle.manifest.parent[:19]}" in text
    assert "onnxruntime" in text


def test_inspect_tells_the_accuracy_with_its_interval(vlatool, int8_bundle, copied):
    found = {"value": 0.9, "low": 0.85, "high": 0.94, "samples": 200}
    bundle = copied(int8_bundle)
    accuracy = {"success": found, "error_expert": {"value": 0.1, "samples": 16}}
    seal(bundle.path, replace(bundle.manifest, accuracy=accuracy))
    _, out, _ = vlatool("inspect", bundle.path)
    assert "accuracy   success 0.9000 (0.8500 to 0.9400), n = 200" in out
    assert "accuracy   error_expert 0.1000, n = 16" in out


def test_inspect_prints_the_manifest_as_it_is_written(vlatool, int8_bundle):
    assert vlatool("inspect", int8_bundle.path, "--json")[1] == (int8_bundle.path / "manifest.json").read_text()


@pytest.mark.parametrize("also", [(), ("--json",)])
def test_a_probe_ends_as_load_would(vlatool, float_bundle, copied, also):
    """A golden action that is three times what the graphs give."""
    bundle = copied(float_bundle)
    arrays = open_npz(bundle.path / bundle.manifest.golden)
    arrays["out.action"] = arrays["out.action"] * 3
    save_npz(bundle.path / bundle.manifest.golden, arrays)
    seal(bundle.path, bundle.manifest)
    code, out, err = vlatool("inspect", bundle.path, "--probe", *also)
    assert code == 3
    assert "golden error 0.67 (allowed 0.01), in physical units " in out or also
    assert "a different golden action than recorded: relative error 0.667, allowed 0.01." in err
    with pytest.raises(GraphError) as caught:
        load(bundle.path)
    assert caught.value.message in err


def test_inspect_runs_a_bundle_once_in_a_process_with_limits(vlatool, int8_bundle):
    code, out, _ = vlatool("inspect", int8_bundle.path, "--probe")
    assert code == 0
    assert "probe      ran once: golden error" in out
    assert f"(allowed {int8_bundle.manifest.golden_tolerance:g})" in out
    assert f"(allowed {int8_bundle.manifest.golden_chunk_tolerance:g}), " in out
    code, _, err = vlatool("inspect", int8_bundle.path, "--probe", "--memory", "20")
    assert code == 3
    assert "more than 20 MB of memory" in err
    assert "--memory MB" in err


# ---- reports


def test_benchmark_means_latency_and_writes_three_reports(vlatool, int8_bundle, float_bundle, tmp_path):
    out = tmp_path / "report"
    line = ["benchmark", float_bundle.path, "--against", int8_bundle.path, *FAST, "-o", out]
    code, told, err = vlatool(*line, "--profile", "raspberry-pi-5")
    assert code == 0
    assert {path.name for path in out.glob("[!.]*")} == {"report.json", "report.html", "report.md"}
    assert told.endswith(f"report: {out / 'report.html'}\n")
    assert "measuring latency" in err
    report = read_report(out)
    assert [row.name for row in report.rows] == ["float32", "static_int8"]
    assert report.rows[0].get("latency_p50", "predicted").where == "raspberry-pi-5"
    assert report.command.startswith("vlatool")
    assert report.created


def test_json_alone_is_on_stdout(vlatool, float_bundle, tmp_path):
    for line in (["benchmark", *FAST], ["benchmark", "overhead", "--iterations", "100"], ["evaluate"]):
        code, out, _ = vlatool(*line, float_bundle.path, "--json", "-o", tmp_path / line[-1])
        assert code == 0
        report = read_report(tmp_path / line[-1])
        assert Report.from_json(out) == replace(report, rows=tuple(replace(row, raw={}) for row in report.rows))


def test_evaluate_means_recorded_and_predicts_for_the_bundle(vlatool, float_bundle, int8_bundle):
    line = ["evaluate", int8_bundle.path, "--baseline", float_bundle.path, "--profile", "raspberry-pi-5", "--json"]
    base, row = Report.from_json(vlatool(*line)[1]).rows
    assert base.get("memory", "predicted") is None
    assert row.get("memory", "predicted") is not None


def test_the_closed_loop_runs_from_the_command_line(vlatool, int8_bundle, policy_template):
    line = ["evaluate", "closed-loop", int8_bundle.path, "--policy", policy_template, "--episodes", 4]
    code, out, _ = vlatool(*line, "--workers", 1, "--tasks", "push", "--first-seed", 1)
    assert code == 0
    assert "100.0% of 4 episodes succeed" in out


def test_an_onnx_file_is_measured_without_a_bundle(vlatool, onnx_file):
    code, out, _ = vlatool("benchmark", onnx_file, *FAST, "--json")
    assert code == 0
    assert Report.from_json(out).rows[0].get("latency_p50").samples == 20


def test_an_existing_report_is_refused_before_anything_is_measured(vlatool, float_bundle, tmp_path):
    code, _, err = vlatool("benchmark", float_bundle.path, *FAST, "-o", tmp_path)
    assert code == 3
    assert "exists already" in err
    assert "measuring" not in err
    code, _, err = vlatool("compare", float_bundle.path, float_bundle.path, "-o", tmp_path)
    assert code == 3
    assert "measuring" not in err


def test_an_existing_report_is_replaced_with_force(vlatool, float_bundle, tmp_path):
    (tmp_path / "report").mkdir()
    assert vlatool("evaluate", float_bundle.path, "-o", tmp_path / "report", "--force")[0] == 0
    assert (tmp_path / "report/report.json").is_file()


def test_bundles_are_compared_in_one_run(vlatool, float_bundle, int8_bundle, tmp_path):
    line = ["compare", float_bundle.path, int8_bundle.path, "--iterations", 20, "-o", tmp_path / "report"]
    assert vlatool(*line)[0] == 0
    report = read_report(tmp_path / "report")
    assert report.kind == "compare"
    assert [row.role for row in report.rows] == ["baseline", "subject"]
    assert report.rows[1].get("speedup") is not None


def test_reports_are_put_side_by_side(vlatool, tmp_path):
    for name, value in (("one", 1.0), ("two", 2.0)):
        row = Row("int8", measurements=(Measurement("latency_p50", value, "ms", samples=20),))
        (tmp_path / f"{name}.json").write_text(Report("benchmark", name, rows=(row,)).to_json())
    (tmp_path / "folder").mkdir()
    shutil.copy(tmp_path / "two.json", tmp_path / "folder/report.json")
    code, out, _ = vlatool("compare", tmp_path / "one.json", tmp_path / "folder", "--json")
    assert code == 0
    report = Report.from_json(out)
    assert [row.name for row in report.rows] == ["one", "folder"]
    assert [row.value("latency_p50") for row in report.rows] == [1.0, 2.0]


@pytest.mark.parametrize(("verdict", "error", "code"), [("fail", GateFailed, 1), ("inconclusive", Inconclusive, 5)])
def test_a_bad_verdict_leaves_with_its_status_and_its_first_sentence(verdict, error, code):
    with pytest.raises(error, match="The first sentence") as caught:
        raise_verdict(Report("evaluate", "t", verdict, summary=("The first sentence.", "another")))
    assert caught.value.exit_code == code
    with pytest.raises(error):
        raise_verdict(Report("evaluate", "t", verdict))


@pytest.mark.parametrize("verdict", ["pass", "info"])
def test_a_good_verdict_leaves_quietly(verdict):
    raise_verdict(Report("evaluate", "t", verdict))


# ---- machine, boards, samples


def test_doctor_says_what_is_there_and_how_to_mend_the_rest(vlatool):
    code, out, _ = vlatool("doctor")
    assert code == 0
    assert any(line.startswith("ok      engine onnxruntime") for line in out.splitlines())
    code, out, _ = vlatool("doctor", "--json")
    checks = json.loads(out)
    assert {check["status"] for check in checks} <= {"ok", "warn", "missing"}
    assert {"name", "status", "finding", "fix"} == set(checks[0])


def test_profiles_are_listed(vlatool):
    code, out, _ = vlatool("profiles", "list")
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == profile_names()
    _, out, _ = vlatool("profiles", "list", "--json")
    assert [profile["name"] for profile in json.loads(out)] == profile_names()


@pytest.mark.parametrize("name", profile_names())
def test_a_profile_is_shown_with_the_source_of_every_figure(vlatool, name):
    code, out, _ = vlatool("profiles", "show", name)
    assert code == 0
    assert f"({name})" in out.splitlines()[0]
    _, as_json, _ = vlatool("profiles", "show", name, "--json")
    shown = json.loads(as_json)
    assert shown["name"] == name
    for key in shown["sources"]:
        assert f"    [{key}] " in out
    assert f"[{shown['memory_gb']['source']}]" in out


def test_a_profile_may_be_a_file_or_in_a_directory_of_ones_own(vlatool, monkeypatch, tmp_path):
    shipped = Path(__file__).parents[2] / "profiles/raspberry-pi-5.yaml"
    own = tmp_path / "my-board.yaml"
    own.write_text(shipped.read_text().replace("name: raspberry-pi-5", "name: my-board"))
    assert json.loads(vlatool("profiles", "show", own, "--json")[1])["name"] == "my-board"
    monkeypatch.setenv("VLATOOL_PROFILES", str(tmp_path))
    assert "my-board" in vlatool("profiles", "list")[1]


def test_samples_are_listed_and_made(vlatool, tmp_path):
    code, out, _ = vlatool("samples", "list")
    listed = [line.split()[0] for line in out.splitlines()]
    assert code == 0
    assert listed == [name.replace("_", "-") for name in registry.names("samples")]
    code, out, _ = vlatool("samples", "make", "action-expert", "-o", tmp_path / "made", "--seed", 3)
    assert (code, out) == (0, f"{tmp_path / 'made'}: action-expert, seed 3\n")
    assert (tmp_path / "made/policy.yaml").is_file()
    assert json.loads((tmp_path / "made/workload.json").read_text())["runs"] == {"main": 1}


# ---- small parts


@pytest.mark.parametrize(
    ("text", "value"), [("1%", 0.01), (" 0.5 % ", 0.005), ("0.01", 0.01), ("100%", 1.0), ("0", 0.0), (".02", 0.02)]
)
def test_a_drop_is_a_percentage_or_a_share(text, value):
    assert share(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "%", "1.5", "101%", "-1", "1 percent", "1e-2", "nan"])
def test_anything_else_is_no_drop(text):
    with pytest.raises(UsageError, match="--max-drop is"):
        share(text)


def test_progress_is_plain_lines_away_from_a_terminal_and_one_for_each_kind(capsys):
    with progress(workers=3) as context:
        for what in ("10 episodes, 80.0% succeed", "20 episodes, 85.0% succeed", "measuring", "measuring"):
            context.progress(what, 0.5)
    assert context.workers == 3
    assert context.command.startswith("vlatool")
    told = capsys.readouterr()
    assert told.err == "... 10 episodes, 80.0% succeed\n... measuring\n"
    assert told.out == ""


def test_numbers_of_a_long_work_are_told_again_every_half_minute(capsys, monkeypatch):
    seconds = iter([0.0, 29.0, 31.0, 32.0])
    monkeypatch.setattr("vlatool.cli._console.time", SimpleNamespace(monotonic=lambda: next(seconds)))
    with progress() as context:
        for count in (10, 20, 30, 40):
            context.progress(f"{count} of 100 episodes", count / 100)
    assert capsys.readouterr().err == "... 10 of 100 episodes\n... 30 of 100 episodes\n"


def test_progress_is_a_bar_on_a_terminal(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress() as context:
        assert isinstance(context, Context)
        context.progress("measuring", None)
        context.progress("measuring", 0.5)
    assert sys.stderr.getvalue().strip()


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (
            ["optimize", "p", "--cache", "/data/me/cache", "-o", "/data/out"],
            "vlatool optimize p --cache cache -o out",
        ),
        (["optimize", "p", "--cache=/data/me/cache", "-o/data/out"], "vlatool optimize p --cache=cache -oout"),
        (["gate", "p", "--junit", "../ci/gate.xml", "-o", "out/x"], "vlatool gate p --junit gate.xml -o out/x"),
        (["export", "p", "-o"], "vlatool export p -o"),
    ],
)
def test_a_command_in_a_report_names_no_folder_of_the_machine(monkeypatch, typed, told) -> None:
    monkeypatch.setattr(sys, "argv", ["vlatool", *typed])
    assert command_line() == told


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_probe_whose_golden_action_is_not_finite_names_what_is_allowed(vlatool, float_bundle, copied, value):
    bundle = copied(float_bundle)
    arrays = open_npz(bundle.path / bundle.manifest.golden)
    arrays["out.action"] = np.full_like(arrays["out.action"], value)
    save_npz(bundle.path / bundle.manifest.golden, arrays)
    seal(bundle.path, bundle.manifest)
    code, _, err = vlatool("inspect", bundle.path, "--probe")
    assert code == 3
    assert "allowed 0.01." in err
    assert "allowed inf" not in err


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("quantize {b} -o o --reduce-range --no-reduce-range", "--reduce-range and --no-reduce-range"),
        ("quantize dynamic-int8 {b} -o o --no-reduce-range --reduce-range", "--reduce-range"),
        ("quantize {b} -o o --per-channel --samples 8 --no-per-channel", "--per-channel and --no-per-channel"),
    ],
)
def test_a_flag_in_both_of_its_forms_is_refused(vlatool, float_bundle, line, said):
    code, _, err = vlatool(*line.format(b=float_bundle.path).split())
    assert code == 2
    assert said in err
    assert "fix: leave one of them out" in err


@pytest.mark.parametrize("line", ["inspect {b} --json --json", "inspect {b} --memory 1 --memory 9000"])
def test_a_flag_that_is_repeated_is_no_contradiction_and_the_last_value_counts(vlatool, float_bundle, line):
    assert vlatool(*line.format(b=float_bundle.path).split())[0] == 0


def test_an_impossible_choice_is_named_without_the_kind_of_error(vlatool, tmp_path):
    code, out, err = vlatool("export", "onnx", "x", "-o", tmp_path / "out", "--exporter", "nope")
    assert (code, out) == (2, "")
    assert "Value error" not in err
    assert "'nope' is not one of 'auto', 'dynamo'" in err


@pytest.mark.parametrize("name", ["my-act", "with space", "#1: act"])
def test_a_new_policy_has_the_name_of_its_directory(policy_dir, tmp_path, name):
    new._copy(policy_dir, tmp_path / name, None)
    assert read_description(tmp_path / name).name == name


def test_a_directory_whose_name_no_policy_may_have_keeps_that_of_the_source(policy_dir, tmp_path):
    own = read_description(policy_dir).name
    new._copy(policy_dir, tmp_path / "a\tb", None)
    assert read_description(tmp_path / "a\tb").name == own
