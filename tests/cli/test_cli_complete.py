"""What a shell completes, asked for as click's shell scripts do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer._completion_classes import BashComplete

from vlatool import registry
from vlatool.cli import app
from vlatool.hardware.platforms import platform_names
from vlatool.hardware.profile import profile_names


@pytest.fixture
def completed():
    """Complete a command line; return what is offered for its last word."""

    def run(*line: str) -> list[str]:
        program = BashComplete(typer.main.get_command(app), {}, "vlatool", "_VLATOOL_COMPLETE")
        *before, last = line
        return [item.value for item in program.get_completions(list(before), last)]

    return run


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a bundle, a policy, an ONNX file, a folder and a text."""
    for name, file in (("a-bundle", "manifest.json"), ("a-policy", "policy.yaml"), ("a-report", "report.json")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).touch()
    (tmp_path / "a-folder" / "deeper").mkdir(parents=True)
    (tmp_path / "a-folder" / "deeper" / "policy.yaml").touch()
    for name in ("a.onnx", "a.txt", ".hidden.onnx"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "line",
    [
        ("optimize", "p", "--profile"), ("benchmark", "p", "--profile"), ("benchmark", "latency", "p", "--profile"),
        ("evaluate", "recorded", "p", "--profile"), ("simulate", "p", "--profile"), ("hwselect", "p", "--boards"),
        ("hwselect", "select", "p", "--boards"), ("profiles", "show"), ("profiles", "diff", "raspberry-pi-5"),
        ("profiles", "validate"), ("profiles", "calibrate"), ("profiles", "new", "mine", "--from"),
    ],
)  # fmt: skip
def test_profiles_are_completed(completed, line: tuple[str, ...]) -> None:
    assert completed(*line, "") == profile_names()
    assert completed(*line, "raspberry") == [name for name in profile_names() if name.startswith("raspberry")]
    assert completed(*line, "no-such") == []


@pytest.mark.parametrize("kind", ["export", "quantize", "benchmark", "evaluate"])
def test_methods_are_completed_beside_what_the_default_one_takes(completed, here, kind: str) -> None:
    offered = completed(kind, "")
    assert offered[: len(registry.names(kind))] == [name.replace("_", "-") for name in registry.names(kind)]
    assert set(offered) >= {"a-bundle", "a-policy", "a.onnx", "a-folder/"}
    assert completed(kind, "a-p") == ["a-policy"]


def test_sources_are_bundles_policies_and_onnx_files(completed, here) -> None:
    for line in (["optimize"], ["quantize", "static-int8"], ["simulate"], ["hwselect", "select"], ["gate", "run"]):
        assert completed(*line, "a") == ["a-bundle", "a-folder/", "a-policy", "a-report/", "a.onnx"]
        assert completed(*line, "a-folder/") == ["a-folder/deeper"]
        assert completed(*line, str(here / "a-b")) == [str(here / "a-bundle")]
        assert completed(*line, "nowhere/") == []
    assert "a-policy" in completed("gate", "a")
    assert "a-policy" in completed("hwselect", "a")


@pytest.mark.parametrize(
    "line", [("inspect",), ("explain",), ("rebuild",), ("gate", "p", "--baseline"), ("evaluate", "p", "--baseline")]
)
def test_bundles_are_completed(completed, here, line: tuple[str, ...]) -> None:
    assert completed(*line, "a-b") == ["a-bundle"]
    assert "a.onnx" not in completed(*line, "a")


def test_reports_and_bundles_are_completed_for_compare(completed, here) -> None:
    assert completed("compare", "a-") == ["a-bundle", "a-folder/", "a-policy/", "a-report"]


def test_names_of_other_things_are_completed(completed) -> None:
    assert completed("samples", "make", "v") == [
        name.replace("_", "-") for name in registry.names("samples") if name.startswith("v")
    ]
    assert completed("benchmark", "p", "--engine", "") == registry.names("engines")
    assert completed("hwselect", "p", "--platform", "") == platform_names()
    assert "int8" in completed("simulate", "p", "--precision", "i")
    assert "--max-drop" in completed("optimize", "p", "--max")
    assert "--per-channel" in completed("quantize", "p", "--per")


def test_a_method_that_is_misspelt_is_no_error_while_completing(completed) -> None:
    assert completed("quantize", "statc-int8", "--nothing") == []


def test_completing_imports_no_library_that_takes_long() -> None:
    code = (
        "import os, sys; sys.argv = ['vlatool']\n"
        "from vlatool.cli import main\n"
        "try: main()\n"
        "except SystemExit as left: print(left.code, file=sys.stderr)\n"
        "print(*{'torch', 'onnx', 'onnxruntime', 'openvino'} & set(sys.modules), file=sys.stderr)\n"
    )
    environment = {"_VLATOOL_COMPLETE": "complete_bash", "COMP_WORDS": "vlatool quantize ", "COMP_CWORD": "2"}
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.stderr.split() == ["0"], done.stderr
    assert "static-int8" in done.stdout.split()
