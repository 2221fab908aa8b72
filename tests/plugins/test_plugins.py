"""A package outside of vlatool adds a method, an engine, a source, a profile and a command by entry points alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from _console import Console
from _environment import environment_beside

from vlatool.bundle.bundle import Bundle

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ENTRY_POINTS = """\
[vlatool.quantize]
rounded = acme_robotics.rounded:Rounded
broken = acme_robotics.broken
no-run = acme_robotics.no_run
static-int8 = acme_robotics.broken
absent = acme_robotics.no_such_file

[vlatool.engines]
acme = acme_robotics.engine
absent = acme_robotics.no_such_engine

[vlatool.sources]
acme = acme_robotics.source
a-first = acme_robotics.no_such_source

[vlatool.profiles]
acme = acme_robotics.boards

[vlatool.commands]
acme = acme_robotics.hello

[vlatool.sections]
acme = acme_robotics.section

[vlatool.videos]
strip = acme_robotics.strip

[vlatool.control]
every-step = acme_robotics.every_step
halved = acme_robotics.halved
"""
Run = Callable[..., subprocess.CompletedProcess[str]]


def wheel(folder: Path) -> Path:
    """Write the wheel of the package; a build backend would need packages that are not here."""
    info = "acme_robotics-1.2.dist-info"
    files = {path.relative_to(HERE).as_posix(): path.read_text() for path in (HERE / "acme_robotics").rglob("*.*")
             if "__pycache__" not in path.parts}  # fmt: skip
    files[f"{info}/METADATA"] = "Metadata-Version: 2.1\nName: acme-robotics\nVersion: 1.2\n"
    files[f"{info}/WHEEL"] = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    files[f"{info}/entry_points.txt"] = ENTRY_POINTS
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    made = folder / "acme_robotics-1.2-py3-none-any.whl"
    with zipfile.ZipFile(made, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return made


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """A function that runs vlatool in a fresh environment in which the package is installed."""
    place = tmp_path_factory.mktemp("plugin")
    python = environment_beside(place / "venv")
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-index", "--no-deps"]
    subprocess.run([*install, str(wheel(place))], check=True)
    environment = {**os.environ, "VLATOOL_CACHE": str(place / "cache"), "COLUMNS": "200"}

    with Console(place, python, environment) as console:
        yield console.run


def ok(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_help_lists_its_method_and_its_command(run: Run):
    assert "rounded " in ok(run("quantize", "--help"))
    assert "Round every weight to a few bits" in ok(run("quantize", "rounded", "--help"))
    assert "  acme " in ok(run("--help"))
    assert ok(run("acme", "robot")) == "hello robot\n"


def test_doctor_says_what_it_adds(run: Run):
    told = {each["name"]: each for each in json.loads(ok(run("doctor", "--json")))}
    finding = told["plugin acme-robotics"]["finding"]
    for added in ("acme-robotics 1.2 adds ", "commands.acme", "engines.acme", "profiles.acme", "quantize.rounded"):
        assert added in finding
    for broken in ("'absent' (vlatool.quantize)", "'absent' (vlatool.engines)", "'a-first' (vlatool.sources)"):
        assert f"{broken}, cannot be imported" in finding
    assert told["engine acme_robotics"]["finding"] == "acme-robotics 1.2: Acme"


def test_its_profile_is_found_by_name(run: Run):
    assert "acme-board" in ok(run("profiles", "list"))
    assert "acme-board" in ok(run("profiles", "show", "acme-board"))


def test_its_method_its_source_and_its_engine_run(run: Run, onnx_file: Path, tmp_path: Path):
    (tmp_path / "tiny.acme").write_text(f"{onnx_file.name}\n")
    ok(run("quantize", "rounded", str(tmp_path / "tiny.acme"), "-o", str(tmp_path / "out"), "--bits", "8"))
    made = json.loads((tmp_path / "out/manifest.json").read_text())["made_by"]
    assert (made["stage"], made["options"]) == ("quantize.rounded", {"bits": 8})
    told = ok(run("benchmark", str(tmp_path / "out"), "--engine", "acme", "--iterations", "20"))
    assert "latency_p50" in told or "p50" in told


def test_its_format_of_videos_is_found_by_the_suffix(run: Run, float_bundle: Bundle, policy_dir: Path, tmp_path: Path):
    line = ["evaluate", "closed-loop", str(float_bundle.path), "--policy", str(policy_dir), "--episodes", "2"]
    assert "worst.strip shows" in ok(run(*line, "--video", str(tmp_path / "worst.strip"))).replace("\n", " ")
    assert np.load(tmp_path / "worst.strip").shape[0] == 6, "of the reset, and after each of five steps"
    ok(run(*line, "--video", str(tmp_path / "worst.strip"), "--force"))
    assert "known: gif, mp4, strip" in run(*line, "--video", str(tmp_path / "worst.avi")).stderr


def test_its_controller_and_its_wrapper_of_policies_play_episodes(run: Run, float_bundle: Bundle, policy_dir: Path):
    line = ["evaluate", "closed-loop", str(float_bundle.path), "--policy", str(policy_dir), "--episodes", "2"]
    told = ok(run(*line, "--controller", "every-step,halved")).replace("\n", " ")
    assert "with the controller every-step,halved" in told
    assert "did you mean 'every_step'" in run(*line, "--controller", "every-stop").stderr
    late = run(*line, "--controller", "every-step", "--latency-in-the-loop")
    assert (late.returncode, "every-step waits for each inference" in late.stderr) == (2, True)


def test_its_controller_acts_as_it_says(run: Run, float_bundle: Bundle):
    code = (
        "from vlatool.episodes.play import EpisodesJob, Worker; from vlatool.data import observations_for; "
        "from vlatool.bundle.bundle import Bundle; "
        f"path = {str(float_bundle.path)!r}; worker = Worker(path, ''); "
        "seen = observations_for(Bundle.open(path), 1)[0]; "
        "made = [worker.controller(EpisodesJob('', '', '', (), controller=names)) for names in "
        "[(), ('halved',), ('every-step',), ('every-step', 'halved')]]; "
        "print([[each.act(seen).tolist() for _ in range(2)] for each in made])"
    )
    plain, halved, first, both = json.loads(ok(run(code=code)))
    np.testing.assert_array_equal(halved, np.array(plain) / 2)
    np.testing.assert_array_equal(first, [plain[0]] * 2)
    np.testing.assert_array_equal(both, [halved[0]] * 2)


def test_optimize_chooses_its_method(run: Run, policy_dir: Path, tmp_path: Path):
    recipe = {"schema": 1, "candidates": {"theirs": [{"quantize.rounded": {"bits": 12}}]}, "search": False}
    (tmp_path / "recipe.yaml").write_text(json.dumps(recipe))
    limits = ["--max-drop", "50%", "--max-memory-mb", "4000", "--episodes", "0", "--iterations", "40"]
    done = run(
        "optimize", str(policy_dir), "--recipe", str(tmp_path / "recipe.yaml"), "-o", str(tmp_path / "o"), *limits
    )
    assert (tmp_path / "o/manifest.json").is_file(), done.stdout + done.stderr
    report = json.loads((tmp_path / "o/reports/report.json").read_text())
    assert {row["name"]: row["role"] for row in report["rows"]}["theirs"] == "chosen", done.stdout


def test_a_search_begins_with_its_method_and_its_engines_plans(run: Run):
    code = "from vlatool.optimize.search import variants_for; print(sorted(variants_for(None, False)))"
    found = ok(run(code=code))
    assert "'rounded'" in found
    assert "'acme_float16'" in found


def test_its_section_is_in_every_format_of_a_report(run: Run):
    code = (
        "from vlatool.render import render; from vlatool.report import Measurement, Report, Row; "
        "row = Row('float32', measurements=(Measurement('latency_p50', 50.0, 'ms'),)); "
        "print(render(Report('benchmark', 't', rows=(row,)), '{}'))"
    )
    for format in ("terminal", "markdown", "html"):
        text = ok(run(code=code.format(format)))
        assert "Inferences in an hour" in text
        assert "72,000" in text


def test_its_bug_is_told_as_its_own(run: Run, onnx_file: Path, tmp_path: Path):
    done = run("quantize", "broken", str(onnx_file), "-o", str(tmp_path / "out"))
    assert done.returncode == 3
    assert "The package acme-robotics 1.2, which adds to vlatool, fails: ZeroDivisionError" in done.stderr
    assert "bug in vlatool" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_method_without_run_is_told_as_unfinished(run: Run, onnx_file: Path, tmp_path: Path):
    done = run("quantize", "no-run", str(onnx_file), "-o", str(tmp_path / "out"))
    assert done.returncode == 3
    assert "quantize.no_run has no method run()" in done.stderr
    assert "bug in vlatool" not in done.stderr


def test_its_method_takes_the_options_that_select_layers(run: Run, policy_dir: Path, tmp_path: Path):
    ok(run("export", str(policy_dir), "-o", str(tmp_path / "float32")))
    done = run("quantize", "rounded", str(tmp_path / "float32"), "--exclude", "*", "-o", str(tmp_path / "out"))
    assert done.returncode == 3
    assert "No layer is left to quantize" in done.stderr


def test_what_cannot_be_imported_is_told_as_its_own(run: Run, onnx_file: Path, tmp_path: Path):
    done = run("quantize", "absent", str(onnx_file), "-o", str(tmp_path / "out"))
    assert done.returncode == 3
    assert "acme-robotics 1.2, which adds 'absent' (vlatool.quantize), cannot be imported" in done.stderr


def test_an_engine_that_cannot_be_imported_stands_in_nobodys_way(run: Run, onnx_file: Path, tmp_path: Path):
    ok(run("quantize", "dynamic-int8", str(onnx_file), "-o", str(tmp_path / "out")))
    done = run("benchmark", str(tmp_path / "out"), "--engine", "absent", "--iterations", "20")
    assert done.returncode == 3
    assert "acme-robotics 1.2, which adds 'absent' (vlatool.engines), cannot be imported" in done.stderr


def test_it_replaces_nothing_of_vlatools_own(run: Run):
    assert "activation ranges" in ok(run("quantize", "static-int8", "--help"))


def test_the_guide_shows_these_files():
    guide = (ROOT / "docs/guides/add-a-method.md").read_text()
    for name in ("rounded", "engine", "source", "section", "every_step", "halved"):
        assert f"```python\n{(HERE / 'acme_robotics' / f'{name}.py').read_text()}```" in guide
