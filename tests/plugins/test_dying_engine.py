"""An engine that ends its process, or hangs, on a graph that nobody has run yet is an error of each command."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from _console import Console
from _environment import environment_beside
from _full import small_or_full

from vlatool.bundle.bundle import Bundle

HERE = Path(__file__).parent
INT8 = "MatMulIntegerToFloat"
HANGS = "engine_seconds=2"
FEW = ("--iterations", "20", "--duration", "0")
Run = Callable[..., subprocess.CompletedProcess[str]]
ENDS = {
    "abort": "ended its process with SIGABRT",
    "crash": "ended its process with SIGSEGV",
    "leave": "called sys.exit(0)",
    "end": "ended its process with exit code 0",
    "hang": "was ended after 2 s, which the limit 'engine_seconds' allows,",
}


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment whose ONNX Runtime dies of some graphs."""
    return environment_beside(tmp_path_factory.mktemp("dying") / "venv", str(HERE), "import dying_engine")


@contextlib.contextmanager
def running(python: Path) -> Iterator[Run]:
    place = python.parents[2]
    environment = {**os.environ, "VLATOOL_CACHE": str(place / "cache"), "COLUMNS": "200"}

    with Console(place, python, environment) as console:

        def call(dies: str, of: str, *words: str) -> subprocess.CompletedProcess[str]:
            limits = HANGS if dies.startswith("hang") else ""
            return console.run(*words, DIES=dies, DIES_OF=of, VLATOOL_LIMITS=limits)

        yield call


@pytest.fixture(scope="module")
def run(python: Path) -> Iterator[Run]:
    """A function that runs vlatool there."""
    with running(python) as call:
        yield call


@pytest.fixture
def fresh(python: Path) -> Iterator[Run]:
    """The same in a process that has run no bundle and asked no engine before."""
    with running(python) as call:
        yield call


def refused(done: subprocess.CompletedProcess[str], how: str, where: Path) -> str:
    """The error of a command that must have left with 3, and must not name what is gone."""
    told = done.stderr
    assert done.returncode == 3, done.stdout + told
    assert "Traceback" not in told
    error = told[told.index("error:") :]
    assert ENDS[how] in error
    assert "ONNX Runtime 1." in error
    assert ".tmp-" not in error
    assert "fix: " in error
    assert not where.exists()
    return error


@pytest.mark.parametrize(("how", "when"), [
    ("abort", "run"), ("hang", "run"), ("crash", "open"),
    *small_or_full([], [(how, when) for how in ENDS for when in ("run", "open")]),
])  # fmt: skip
def test_quantize_says_what_the_engine_did(run: Run, float_bundle: Bundle, tmp_path: Path, how: str, when: str):
    line = ("quantize", "static-int8", str(float_bundle.path), "--samples", "4", "-o", str(tmp_path / "out"))
    error = refused(run(f"{how}:{when}", INT8, *line), how, tmp_path / "out")
    assert f"when it {'opened' if when == 'open' else 'ran'} the graph 'main'" in error
    if how == "abort":
        assert "It said last: engine.cc:1130: Assertion '__n < this->size()' failed." in error


def test_quantize_survives_a_calibration(run: Run, float_bundle: Bundle, tmp_path: Path):
    line = ("quantize", "static-int8", str(float_bundle.path), "--samples", "4", "-o", str(tmp_path / "out"))
    error = refused(run("abort:run", "", *line), "abort", tmp_path / "out")
    assert "when it ran the graph 'main' with additional outputs" in error


@pytest.mark.parametrize("when", ["run", *small_or_full([], ["open"])])
def test_export_does_not_blame_the_policy(run: Run, policy_dir: Path, tmp_path: Path, when: str):
    error = refused(
        run(f"abort:{when}", "", "export", str(policy_dir), "-o", str(tmp_path / "out")), "abort", tmp_path / "out"
    )
    assert "policy.py" not in error


def test_an_onnx_file_is_refused(run: Run, onnx_file: Path, tmp_path: Path):
    refused(run("crash:open", "", "export", str(onnx_file), "-o", str(tmp_path / "out")), "crash", tmp_path / "out")


def test_what_opens_a_bundle_from_elsewhere_survives(fresh: Run, int8_bundle: Bundle, tmp_path: Path):
    made = str(int8_bundle.path)
    for line in (
        ("evaluate", "recorded", made), ("benchmark", made, *FEW),
        *small_or_full([], [("explain", made), ("benchmark", "overhead", made)]),
    ):  # fmt: skip
        done = fresh("abort:run", INT8, *line, "-o", str(tmp_path / "report"))
        assert done.returncode == 3, (line, done.stdout + done.stderr)
        assert "SIGABRT" in done.stderr
        assert "Assertion" in done.stderr


def test_doctor_names_an_engine_that_dies_of_its_own_products(fresh: Run):
    done = fresh("abort:probe", "", "doctor", "--json")
    told = {each["name"]: each for each in json.loads(done.stdout)}
    assert told["int8 ort_cpu"]["status"] == "warn"
    assert "ended its process with SIGABRT when it computed small int8 products" in told["int8 ort_cpu"]["finding"]
    assert told["python"]["finding"], "the rest is told as well"


def test_no_command_dies_of_the_products_that_an_engine_is_asked_for(
    fresh: Run, float_bundle: Bundle, int8_bundle: Bundle, tmp_path: Path
):
    made = str(int8_bundle.path)
    for line in (
        ("quantize", "static-int8", str(float_bundle.path), "--samples", "4", "-o", str(tmp_path / "out")),
        ("evaluate", "recorded", made), *small_or_full([], [("benchmark", made, *FEW), ("inspect", made, "--probe")]),
    ):  # fmt: skip
        done = fresh("abort:probe", "", *line)
        assert done.returncode in (0, 3), (line, done.stdout + done.stderr)
        assert done.returncode == 0 or "SIGABRT" in done.stderr, (line, done.stderr)


def test_a_search_goes_on_without_the_candidate(run: Run, float_bundle: Bundle, policy_dir: Path, tmp_path: Path):
    model = shutil.copyfile(float_bundle.path / "graphs/main.onnx", policy_dir / "tiny.onnx")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("candidates:\n  int8: [{quantize.static_int8: {samples: 4}}]\n  half: [{quantize.float16: {}}]\n")
    line = ("optimize", str(model), "--recipe", str(recipe), "--max-drop", "relative_error=0.9", "--no-search")
    few = ("--episodes", "0", "--iterations", "20")
    done = run("abort:run", INT8, *line, *few, "-o", str(tmp_path / "out"))
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "out/reports/report.json").read_text())
    (failed,) = [row for row in report["rows"] if row["name"] == "int8"]
    assert "SIGABRT" in failed["reason"]
