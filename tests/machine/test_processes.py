from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from _full import small_or_full

import vlatool
from vlatool.machine.processes import SINGLE, import_path, python_code, python_command, single_threads

PACKAGE = str(Path(vlatool.__file__).resolve().parents[1])
SHADOWS = ("random", "json", "torch", "numpy", "runpy", "tempfile", "onnx", "onnxruntime", "sitecustomize")
MAIN = "import sys\nfrom vlatool.cli import main\nmain()\n"


@pytest.fixture
def shadowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current directory with modules that are called as those of others, and leave a mark when they are imported."""
    place = tmp_path / "here"
    place.mkdir()
    for name in SHADOWS:
        (place / f"{name}.py").write_text("import pathlib\npathlib.Path(__file__).with_suffix('.ran').touch()\n")
    monkeypatch.chdir(place)
    return place


def marks(place: Path) -> list[str]:
    return sorted(path.name for path in place.glob("*.ran"))


def test_processes_that_are_started_meanwhile_compute_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with single_threads():
        assert {os.environ[name] for name in SINGLE} == {"1"}
    assert os.environ["OMP_NUM_THREADS"] == "5"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_process_finds_this_vlatool_from_anywhere(tmp_path: Path) -> None:
    line = python_code("import vlatool; print(vlatool.__file__)")
    told = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert str(Path(told.strip()).parents[1]) == PACKAGE


def test_a_module_gets_its_arguments(tmp_path: Path) -> None:
    done = subprocess.run(
        python_command("json.tool", ("--compact",)), input='{"a": [1, 2]}', capture_output=True, text=True, check=True
    )
    assert done.stdout == '{"a":[1,2]}\n'


@pytest.mark.parametrize("first", ["", "here"])
def test_the_current_directory_is_not_where_children_import_from(
    shadowed: Path, monkeypatch: pytest.MonkeyPatch, first: str
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    monkeypatch.setattr(sys, "path", [first and str(shadowed), *sys.path])
    assert str(shadowed) not in import_path()
    assert "" not in import_path()
    for line in (python_code("import random, json, numpy"), python_command("vlatool.quantize.streamed._worker")):
        subprocess.run(line, input="", text=True, check=True)
    assert marks(shadowed) == []


def test_the_current_directory_counts_where_the_user_names_it(shadowed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"/somewhere/else{os.pathsep}{shadowed}")
    monkeypatch.setattr(sys, "path", [str(shadowed), *sys.path])
    assert import_path()[0] == str(shadowed)


def test_this_vlatool_comes_before_what_is_installed_and_after_python(monkeypatch: pytest.MonkeyPatch) -> None:
    library, installed = os.path.dirname(os.__file__), "/usr/lib/python3/site-packages"
    monkeypatch.setattr(sys, "path", [library, installed])
    assert import_path() == [library, PACKAGE, installed]
    monkeypatch.setattr(sys, "path", [library])
    assert import_path() == [library, PACKAGE]


WAYS = [(command, started) for command in ("export", "benchmark", "closed-loop", "refit")
        for started in ("script", "module")]  # fmt: skip
FEW = [("closed-loop", "module"), ("benchmark", "script"), ("refit", "script")]
"""Both ways of starting, and each kind of child: of the server, of a measurement, of multiprocessing."""


@pytest.mark.parametrize(("command", "started"), small_or_full(FEW, WAYS))
def test_modules_in_the_current_directory_do_not_run_in_children(
    shadowed, started, command, policy_template, float_bundle, points_file, tmp_path
) -> None:
    words = {
        "export": ["export", policy_template, "-o", tmp_path / "out"],
        "benchmark": ["benchmark", float_bundle.path, "--iterations", 20, "--duration", 0],
        "closed-loop": ["evaluate", "closed-loop", float_bundle.path, "--policy", policy_template, "--episodes", 2],
        "refit": ["hwselect", "score", points_file, "--held-out", "models", "--refit", 0],
    }[command]
    (tmp_path / "vlatool.py").write_text(MAIN.replace("import sys\n", "import sys\nsys.path.pop(0)\n"))
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if started == "script":
        line = [sys.executable, str(tmp_path / "vlatool.py")]
        environment["PYTHONPATH"] = PACKAGE
    else:  # Python itself puts the current directory first; what is imported here already is not imported from there
        code = f"import sys; sys.path.insert(1, {PACKAGE!r}); import {', '.join(SHADOWS[:2])}, numpy, torch, onnx, "
        code = code.replace("import sys;", "import sys; first = sys.path.pop(0);")
        code += "onnxruntime, runpy, tempfile; from vlatool.cli import main; sys.path.insert(0, first); main()"
        line = [sys.executable, "-c", code]
    done = subprocess.run([*line, *map(str, words)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert marks(shadowed) == []
