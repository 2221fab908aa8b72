from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest

from vlatool.cli._console import MISSED_FIX
from vlatool.gate import run, timing_processes
from vlatool.measurement.agreement import run_agreement
from vlatool.measurement.pairs import Pairs

QUICK = "{latency: {interim_analyses: [10]}, memory: null}"


@pytest.fixture
def slowdown(monkeypatch: pytest.MonkeyPatch):
    """A function that sets how much slower the candidate seems to be; no process is started."""

    def make(share: float) -> None:
        monkeypatch.setattr(
            timing_processes,
            "measure_pairs",
            lambda job, timeout: Pairs((2.0,) * 50, (2.0 * (1 + share) + 1e-4 * (job.seed % 10),) * 50),
        )
        monkeypatch.setattr(run, "measure_agreement", lambda job, timeout: run_agreement(job))

    return make


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "own.yaml"
    path.write_text(QUICK)
    return path


@pytest.mark.parametrize(("share", "code", "word"), [(0.0, 0, "PASS"), (0.3, 1, "FAIL"), (0.0499, 5, "INCONCLUSIVE")])
def test_the_exit_code_is_the_verdicts(vlatool, float_bundle, slowdown, config, share, code, word) -> None:
    slowdown(share)
    got, out, err = vlatool("gate", float_bundle.path, "--baseline", float_bundle.path, "--config", config)
    assert got == code, err
    assert out.startswith(word)
    assert all(len(line) <= 80 for line in out.splitlines())
    assert "latency: " in out


def test_json_junit_and_a_directory_of_reports(vlatool, float_bundle, slowdown, config, tmp_path) -> None:
    slowdown(0.3)
    line = ["gate", float_bundle.path, "--baseline", float_bundle.path, "--config", config, "--json",
            "--junit", tmp_path / "deep/gate.xml", "-o", tmp_path / "out"]  # fmt: skip
    code, out, _ = vlatool(*line)
    assert code == 1
    found = json.loads(out)
    assert (found["kind"], found["verdict"]) == ("gate", "fail")
    error = {"type": "GateFailed", "message": found["summary"][0], "fix": MISSED_FIX, "exit_code": 1}
    assert found["error"] == error, "the verdict stands beside its report"
    assert found["command"].startswith("vlatool")
    assert ElementTree.parse(tmp_path / "deep/gate.xml").getroot().get("failures") == "1"
    assert {path.name for path in (tmp_path / "out").glob("[!.]*")} == {"report.json", "report.html", "report.md"}


def test_junit_may_lie_in_the_directory_of_reports(vlatool, float_bundle, slowdown, config, tmp_path) -> None:
    slowdown(0.3)
    for force in ([], ["--force"]):
        line = ["gate", float_bundle.path, "--baseline", float_bundle.path, "--config", config, "-o", tmp_path / "out",
                "--junit", tmp_path / "out/gate.xml", *force]  # fmt: skip
        assert vlatool(*line)[0] == 1
        assert ElementTree.parse(tmp_path / "out/gate.xml").getroot().get("failures") == "1"
        assert (tmp_path / "out/report.html").is_file()


def test_a_step_summary_that_cannot_be_written_is_a_warning(
    vlatool, float_bundle, slowdown, config, tmp_path, monkeypatch
) -> None:
    slowdown(0.0)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path))
    code, _, err = vlatool("gate", float_bundle.path, "--baseline", float_bundle.path, "--config", config)
    assert code == 0
    assert "warning: the step summary" in err


def test_a_job_of_github_gets_annotations_and_a_summary(
    vlatool, float_bundle, slowdown, config, tmp_path, monkeypatch
) -> None:
    slowdown(0.3)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary.md"))
    (tmp_path / "summary.md").write_text("before\n")
    code, out, _ = vlatool("gate", float_bundle.path, "--baseline", float_bundle.path, "--config", config)
    assert code == 1
    assert out.startswith("::error title=Gate of tiny%3A latency fail::30.0%25 slower")
    summary = (tmp_path / "summary.md").read_text()
    assert summary.startswith("before\n### ❌ FAIL: tiny does not keep to: latency.")


def test_the_margin_and_the_gate_of_the_directory(vlatool, float_bundle, slowdown, tmp_path, monkeypatch) -> None:
    slowdown(0.3)
    monkeypatch.chdir(tmp_path)
    Path("gate.yaml").write_text(
        f"{{baseline: {float_bundle.path}, latency: {{interim_analyses: [10]}}, memory: null}}"
    )
    assert vlatool("gate", float_bundle.path)[0] == 1
    assert vlatool("gate", float_bundle.path, "--margin", 0.5)[0] == 0


def test_init_writes_what_the_gate_then_reads(vlatool, float_bundle, slowdown, tmp_path, monkeypatch) -> None:
    slowdown(0.0)
    code, out, _ = vlatool("gate", "init", tmp_path, "--baseline", "base", "--candidate", "pol")
    assert code == 0
    assert out.splitlines() == [
        f"written: {tmp_path / 'gate.yaml'}", f"written: {tmp_path / '.github/workflows/policy-gate.yml'}",
        f"written: {tmp_path / '.gitlab/policy-gate.yml'}",
        "GitLab reads its job when .gitlab-ci.yml says: include: {local: .gitlab/policy-gate.yml}",
        f"next: vlatool gate pol   # in {tmp_path}",
    ]  # fmt: skip
    (tmp_path / "base").symlink_to(float_bundle.path)
    assert vlatool("gate", float_bundle.path, "--config", tmp_path / "gate.yaml")[0] == 0
    code, _, err = vlatool("gate", "init", tmp_path)
    assert code == 3
    assert "gate.yaml exists already" in err
    assert vlatool("gate", "init", tmp_path, "--force")[0] == 0


def test_init_with_force_replaces_only_what_nobody_changed(vlatool, tmp_path) -> None:
    assert vlatool("gate", "init", tmp_path)[0] == 0
    (tmp_path / "gate.yaml").write_text((tmp_path / "gate.yaml").read_text().replace("0.05", "0.02"))
    before = (tmp_path / "gate.yaml").read_text()
    code, _, err = vlatool("gate", "init", tmp_path, "--force")
    assert (code, (tmp_path / "gate.yaml").read_text()) == (3, before)
    assert "gate.yaml was not written by vlatool, or was changed since" in err


@pytest.mark.parametrize("name", ["notes.txt", "link.xml", "bundle/gate.xml"])
def test_junit_is_written_over_nothing_that_is_not_vlatools(vlatool, float_bundle, tmp_path, name) -> None:
    shutil.copytree(float_bundle.path, tmp_path / "bundle")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "link.xml").symlink_to("notes.txt")
    line = ["gate", tmp_path / "bundle", "--baseline", float_bundle.path, "--junit", tmp_path / name, "--force"]
    code, _, err = vlatool(*line)
    assert (code, (tmp_path / "notes.txt").read_text()) == (3, "mine"), err
    assert not (tmp_path / "bundle/gate.xml").exists()


def test_init_writes_nothing_where_it_cannot_write_all(vlatool, tmp_path) -> None:
    (tmp_path / ".github").write_text("in the way")
    code, out, err = vlatool("gate", "init", tmp_path)
    assert (code, out) == (3, "")
    assert ".github" in err
    assert not (tmp_path / "gate.yaml").exists()


def test_init_on_a_full_disk_names_the_file_and_leaves_no_empty_folder(vlatool, tmp_path, monkeypatch) -> None:
    def full(*_args: object, **_options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    code, _, err = vlatool("gate", "init", tmp_path / "new")
    assert (code, err.splitlines()[0]) == (3, f"error: Cannot write {tmp_path / 'new/gate.yaml'}: the disk is full.")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        (["{bundle}"], 2, "No baseline to compare with."),
        (["{bundle}", "--baseline", "{tmp}/none"], 3, "fix: make one: vlatool export POLICY -o"),
        (["{bundle}", "--baseline", "{bundle}", "--margin", "inf"], 2, "--margin"),
        (["{bundle}", "--baseline", "{bundle}", "--junit", "{tmp}"], 3, "is a directory"),
        (["{bundle}", "--baseline", "{bundle}", "--junit", "{bundle}/manifest.json/g.xml"], 3, "cannot be written"),
        (["{tmp}/none", "--baseline", "{bundle}"], 3, "none"),
        (["{bundle}", "--baseline", "{bundle}", "--config", "{tmp}/none.yaml"], 3, "There is no gate"),
        (["{bundle}", "--baseline", "{bundle}", "--margin=-1"], 2, "--margin"),
        (["{bundle}", "--baseline", "{bundle}", "--seed=-1"], 2, "--seed"),
        (["{bundle}", "--baseline", "{bundle}", "-o", "{tmp}"], 3, "is the current directory"),
        (["{bundle}", "--baseline", "{tmp}"], 3, "manifest"),
        (["{bundle}", "--baselin", "{bundle}"], 2, "--baseline"),
    ],
)
def test_what_is_wrong_is_said(vlatool, float_bundle, tmp_path, monkeypatch, line, code, says) -> None:
    monkeypatch.chdir(tmp_path)
    got, out, err = vlatool("gate", *(part.format(bundle=float_bundle.path, tmp=tmp_path) for part in line))
    assert (got, out) == (code, "")
    assert says in err
    assert "Traceback" not in err
