"""A package outside of vlatool adds a method, an engine, a source, a profile and a command by entry points alone."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
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
openvino-provider = acme_robotics.openvino_provider
ggml-provider = acme_robotics.ggml_provider
absent = acme_robotics.no_such_engine

[vlatool.sources]
acme = acme_robotics.source
acme-checkpoint = acme_robotics.checkpoint
a-first = acme_robotics.no_such_source

[vlatool.data]
acme-log = acme_robotics.log

[vlatool.profiles]
acme = acme_robotics.boards

[vlatool.commands]
acme = acme_robotics.hello

[vlatool.sections]
acme = acme_robotics.section

[vlatool.measures]
acme = acme_robotics.tail

[vlatool.claims]
bounded = acme_robotics.claim
missing = acme_robotics.no_such_claim

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
    assert told["engine acme_robotics"]["finding"] == "acme-robotics 1.2: Azure, CPU"


def test_its_profile_is_found_by_name(run: Run):
    assert "acme-board" in ok(run("profiles", "list"))
    assert "acme-board" in ok(run("profiles", "show", "acme-board"))


def test_its_method_its_source_and_its_engine_run(run: Run, onnx_file: Path, tmp_path: Path):
    (tmp_path / "tiny.acme").write_text(f"{onnx_file.name}\n")
    ok(run("quantize", "rounded", str(tmp_path / "tiny.acme"), "-o", str(tmp_path / "out"), "--bits", "8"))
    made = json.loads((tmp_path / "out/manifest.json").read_text())["made_by"]
    assert (made["stage"], made["options"]) == ("quantize.rounded", {"bits": 8})
    few = ("--iterations", "20", "--duration", "0", "--no-cold")
    done = ok(run("benchmark", str(tmp_path / "out"), "--engine", "acme", *few, "--json"))
    (row,) = json.loads(done)["rows"]
    assert row["details"]["engine"][0]["providers"].startswith("AzureExecutionProvider {}; CPUExecutionProvider {}; ")


@pytest.fixture
def log(policy_template: Path, tmp_path: Path) -> Path:
    """The recording of the tiny policy as the package's robot logs it: a directory, of which one file is large."""
    folder = tmp_path / "a.log"
    (folder / "more").mkdir(parents=True)
    with np.load(policy_template / "calibration.npz") as stored:
        arrays = dict(stored)
    large = {"image": arrays.pop("image")}
    for name, values in large.items():
        (folder / f"{name}.raw").write_bytes(values.tobytes())
    about = {name: {"shape": values.shape, "dtype": str(values.dtype)} for name, values in large.items()}
    small = {name: values.tolist() for name, values in arrays.items()}
    times = [0.1 * number for number in range(len(large["image"]))]
    (folder / "log.json").write_text(json.dumps({"large": about, "small": small, "times": times}))
    (folder / "more/notes.txt").write_text("windy\n")
    return folder


@pytest.fixture
def checkpoint(policy_dir: Path, log: Path) -> Path:
    """The tiny policy as the package's trainer leaves it: no policy.yaml and no .npz."""
    described = yaml.safe_load((policy_dir / "policy.yaml").read_text())
    acme = {"model": "tiny", "revision": "1.2.0", "tensors": described["spec"], "code": "policy.py:make", "log": "log"}
    (policy_dir / "acme.json").write_text(json.dumps({**acme, "simulation": described["environment"]}))
    for name in ("policy.yaml", "calibration.npz", "evaluation.npz"):
        (policy_dir / name).unlink()
    log.rename(policy_dir / "log")
    return policy_dir


def test_its_directories_are_a_source_and_a_recording(run: Run, checkpoint: Path, tmp_path: Path):
    float32, int8 = tmp_path / "float32", tmp_path / "int8"
    ok(run("export", str(checkpoint), "-o", str(float32)))
    bundle = Bundle.open(float32)
    assert {name for name in bundle.manifest.files if name.startswith("data/")} == {
        "data/calibration/image.raw", "data/calibration/log.json", "data/calibration/more/notes.txt",
    }  # fmt: skip
    ok(run("quantize", "static-int8", str(checkpoint), "-o", str(int8)))
    samples = json.loads((int8 / "manifest.json").read_text())["made_by"]["calibration"]["samples"]
    told = ok(run("evaluate", str(int8), "--baseline", str(float32), "--json"))
    assert "held out of it" in json.loads(told)["warnings"][0]
    whole = ok(run("evaluate", str(int8), "--data", str(checkpoint / "log"), "--json"))
    assert json.loads(whole)["title"] == f"tiny on {2 * samples} recorded observations"
    ok(run("evaluate", "closed-loop", str(float32), "--policy", str(checkpoint), "--episodes", "2"))
    assert "static_int8" in ok(run("optimize", str(checkpoint), "--dry-run", "-o", str(tmp_path / "o")))
    assert "identical" in ok(run("rebuild", str(int8), "--check", "--trust", str(checkpoint)))
    (checkpoint / "log/more/notes.txt").write_text("calm!\n")
    done = run("rebuild", str(int8), "--check", "--source", str(checkpoint))
    assert f"The source {checkpoint} is not what {int8} was made from: log: got sha256:" in " ".join(
        done.stderr.split()
    )
    (checkpoint / "log/log.json").unlink()
    assert "log is of an unknown format" in run("export", str(checkpoint), "-o", str(tmp_path / "again")).stderr


def test_its_recording_is_a_file_of_a_stage_with_all_that_is_in_it(run: Run, float_bundle: Bundle, log: Path):
    out = log.parent / "int8"
    ok(run("quantize", "static-int8", str(float_bundle.path), "--calibration", str(log), "-o", str(out)))
    made = json.loads((out / "manifest.json").read_text())["made_by"]
    assert list(made["files"]) == ["a.log"]
    assert made["options"]["calibration"] == f"a.log sha256:{made['files']['a.log'][:16]}"
    again = ("rebuild", str(out), "--source", str(float_bundle.path), "--file", str(log), "--check")
    assert "identical" in ok(run(*again))
    (log / "more/notes.txt").write_text("calm!\n")
    done = run(*again)
    assert "quantize.static_int8 was given the file a.log with sha256:" in done.stderr


def test_two_sources_that_are_certain_are_both_named(run: Run, checkpoint: Path, policy_template: Path, tmp_path: Path):
    shutil.copy(policy_template / "policy.yaml", checkpoint)
    for line in (("export", "-o", str(tmp_path / "out")), ("optimize", "--dry-run", "-o", str(tmp_path / "out"))):
        done = run(line[0], str(checkpoint), *line[1:])
        assert done.returncode == 3
        assert "is ambiguous" in done.stderr
        for each in ("acme_checkpoint (a directory with an acme.json)", "torch_module (a directory with a policy.yaml"):
            assert each in " ".join(done.stderr.split())
    ok(run("export", str(checkpoint / "policy.yaml"), "-o", str(tmp_path / "named")))


def test_what_no_source_reads_is_told_what_each_of_them_needs(run: Run, tmp_path: Path):
    (tmp_path / "act").mkdir()
    for name in ("config.json", "model.safetensors"):
        (tmp_path / "act" / name).write_text("{}")
    told = " ".join(run("export", str(tmp_path / "act"), "-o", str(tmp_path / "out")).stderr.split())
    assert "act is not a bundle: it has no manifest.json" in told
    assert "(found: config.json, model.safetensors); it looks like a checkpoint of another library" in told
    for each in ("acme (a .acme file)", "acme_checkpoint (a directory with an acme.json)", "onnx (a .onnx file)"):
        assert each in told


def test_its_directory_is_completed(run: Run, checkpoint: Path):
    code = f"from vlatool.cli._complete import sources; print(sources({str(checkpoint.parent)!r} + '/ti'))"
    assert ok(run(code=code)) == f"['{checkpoint}']\n"


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


def test_optimize_chooses_its_method(run: Run, float_bundle: Bundle, policy_dir: Path, tmp_path: Path):
    model = shutil.copyfile(float_bundle.path / "graphs/main.onnx", policy_dir / "tiny.onnx")
    recipe = {"schema": 1, "candidates": {"theirs": [{"quantize.rounded": {"bits": 12}}]}, "search": False}
    (tmp_path / "recipe.yaml").write_text(json.dumps(recipe))
    limits = ["--max-drop", "50%", "--max-memory-mb", "4000", "--episodes", "0", "--iterations", "40"]
    done = run("optimize", str(model), "--recipe", str(tmp_path / "recipe.yaml"), "-o", str(tmp_path / "o"), *limits)
    assert (tmp_path / "o/manifest.json").is_file(), done.stdout + done.stderr
    report = json.loads((tmp_path / "o/reports/report.json").read_text())
    assert {row["name"]: row["role"] for row in report["rows"]}["theirs"] == "chosen", done.stdout


def test_a_search_begins_with_its_method_and_its_engines_plans(run: Run):
    code = "from vlatool.optimize.search import variants_for; print(sorted(variants_for(None, False)))"
    found = ok(run(code=code))
    assert "'rounded'" in found
    assert "'acme_float16'" in found
    assert "acme_int8" not in found


def test_its_engine_knows_the_board_that_a_search_is_for(run: Run):
    code = "from vlatool.hardware.profile import load_profile; from vlatool.optimize.search import variants_for; "
    assert "acme_int8" in ok(run(code=f"{code}print(*variants_for(load_profile('acme-board'), True))"))


def test_what_its_engine_is_built_against_is_in_keys_and_records(run: Run, float_bundle: Bundle):
    code = (
        "from unittest import mock; from vlatool.quantize.float16 import Float16; from vlatool.runtime import engine\n"
        "key, acme = Float16().key('a'), engine.engine_class('acme'); print(engine.identities())\n"
        "with mock.patch.object(acme, 'providers', acme.providers[1:]): print(key == Float16().key('a'))"
    )
    identity, same = ok(run(code=code)).splitlines()
    assert "'acme': 'AzureExecutionProvider {}; CPUExecutionProvider {}; onnxruntime " in identity
    assert "acme-robotics 1.2" in identity
    assert same == "False"


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


def test_its_measure_is_in_the_report_the_comparison_and_the_schema(run: Run, float_bundle: Bundle, tmp_path: Path):
    line = ["benchmark", str(float_bundle.path), "--iterations", "20", "--duration", "0", "--no-cold"]
    ok(run(*line, "-o", str(tmp_path / "one")))
    (tmp_path / "other.json").write_text((tmp_path / "one/report.json").read_text())
    compared = json.loads(ok(run("compare", str(tmp_path / "one"), str(tmp_path / "other.json"), "--json")))
    for row in (*json.loads((tmp_path / "one/report.json").read_text())["rows"], *compared["rows"]):
        (found,) = (item for item in row["measurements"] if item["name"] == "acme_tail")
        assert (found["unit"], found["samples"], found["value"] >= 1) == ("x", 20, True)
    for format in ("html", "md"):
        assert "slowest call over median" in (tmp_path / f"one/report.{format}").read_text()
    generate = str(ROOT / "docs/generate.py")
    schema = json.loads(ok(run(code=f"import runpy; print(runpy.run_path({generate!r})['schema_page']())")))
    known = {"title": "slowest call over median", "unit": "x", "better": "less", "section": "further", "interval": ""}
    assert schema["measures"]["acme_tail"] == known


@pytest.mark.parametrize(
    ("options", "code", "found"),
    [
        ({"bound": 1000, "max_share": 0.6}, 0, "pass: 0.0% of 16 actions are larger than 1000 (0.0% to "),
        ({"bound": 0, "max_share": 0.4}, 1, "fail: 100.0% of 16 actions are larger than 0 ("),
        ({"bound": 1000, "max_share": 0.01}, 5, "inconclusive: 0.0% of 16 actions are larger than 1000 ("),
    ],
)
def test_its_gate_claim_decides(
    run: Run, float_bundle: Bundle, tmp_path: Path, options: dict[str, float], code: int, found: str
):
    done = run(*gated(float_bundle, tmp_path, bounded=options), "--json", "--junit", str(tmp_path / "gate.xml"))
    assert done.returncode == code, done.stdout + done.stderr
    report = json.loads(done.stdout)
    (line,) = report["rows"][1]["details"]["claims"]
    assert f"{line['verdict']}: {line['found']}".startswith(found)
    assert (line["claim"], report["rows"][1]["measurements"][0]["name"]) == ("bounded", "large_actions")
    assert "bounded" in (tmp_path / "gate.xml").read_text()


def gated(bundle: Bundle, folder: Path, **claims: object) -> list[str]:
    """Return the command line of a gate with these claims alone."""
    off = dict.fromkeys(("latency", "accuracy", "answers", "memory", "size"))
    (folder / "gate.yaml").write_text(json.dumps({**off, **claims}))
    return ["gate", str(bundle.path), "--baseline", str(bundle.path), "--config", str(folder / "gate.yaml")]


def test_its_gate_claim_is_in_a_new_gate_file_and_examined_where_it_is_named(
    run: Run, float_bundle: Bundle, tmp_path: Path
):
    ok(run("gate", "init", str(tmp_path / "new")))
    assert "\nbounded: null  # Few of the candidate's actions" in (tmp_path / "new/gate.yaml").read_text()
    wrong = run(*gated(float_bundle, tmp_path, bounded={"bound": -1, "share": 1}))
    assert wrong.returncode == 3
    for problem in ("bounded.bound: Input should be greater than or equal to 0", "bounded.share: is not a known"):
        assert problem in wrong.stderr
    report = json.loads(ok(run(*gated(float_bundle, tmp_path, size={}), "--json")))
    assert [line["claim"] for line in report["rows"][1]["details"]["claims"]] == ["size"]


def test_a_gate_claim_that_cannot_be_imported_fails_where_it_is_named(run: Run, float_bundle: Bundle, tmp_path: Path):
    done = run(*gated(float_bundle, tmp_path, missing={}))
    assert done.returncode == 3
    assert "acme-robotics 1.2, which adds 'missing' (vlatool.claims), cannot be imported" in done.stderr


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
    files = ("rounded", "openvino_provider", "ggml_provider", "source", "checkpoint", "log", "section", "tail")
    for name in (*files, "every_step", "halved", "claim"):
        assert f"```python\n{(HERE / 'acme_robotics' / f'{name}.py').read_text()}```" in guide
