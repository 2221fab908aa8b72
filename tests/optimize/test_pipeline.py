"""``optimize`` end to end on the tiny policy, through the command line.

One run starts from torch, with the closed loop; the others start from an ONNX file, which needs no export. With a rate
that nothing reaches (``NEAREST``), the choice does not depend on what was measured.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _arithmetic import full_range_or_less
from _full import small_or_full

from vlatool.benchmark import latency
from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.cli._run import with_graphs
from vlatool.errors import RecipeError, SourceError
from vlatool.hardware.profile import load_profile
from vlatool.optimize.plan import make_plan
from vlatool.optimize.recipe import Effort, Limits, default_recipe, read_recipe
from vlatool.report import Report, read_report
from vlatool.runtime import load
from vlatool.sources import brings_calibration, source_bundle, source_stage
from vlatool.sources.onnx import OnnxFile
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

FEW = ["--profile", "raspberry-pi-5", "--iterations", "20", "--workers", "1", "--episodes", "0"]
NEAREST = ["--max-drop", "100%", "--hz", "1000000"]
DYNAMIC = "candidates: {mine: [quantize.dynamic_int8: {}]}"
STATIC = "candidates: {mine: [quantize.static_int8: {samples: 8}]}"
BAD = "candidates: {bad: [quantize.static_int8: {samples: 8, method: percentile, percentile: 51}]}"
MISSING = "candidates: {good: [quantize.dynamic_int8: {}], lost: [quantize.static_int8: {calibration: none.npz}]}"


@dataclass(frozen=True)
class Run:
    """One run of ``optimize``."""

    code: int
    stdout: str
    stderr: str
    out: Path
    cache: Path

    @property
    def report(self) -> Report:
        return read_report(self.out)

    def row(self, name: str) -> Any:
        return next(row for row in self.report.rows if row.name == name)


def optimize(source: Path, out: Path, cache: Path, *more: Any) -> Run:
    line = ["optimize", source, "-o", out, "--cache", cache, *FEW, *more]
    with contextlib.redirect_stdout(io.StringIO()) as stdout, contextlib.redirect_stderr(io.StringIO()) as stderr:
        try:
            main([str(part) for part in line])
            code: Any = 0
        except SystemExit as left:
            code = left.code or 0
    return Run(code, stdout.getvalue(), stderr.getvalue(), out, cache)


@pytest.fixture(scope="session")
def from_torch(policy_template, tmp_path_factory) -> Run:
    """The whole way, all default candidates, once; read only."""
    folder = tmp_path_factory.mktemp("optimized")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(latency, "COLD_STARTS", small_or_full(1, latency.COLD_STARTS))
        run = optimize(
            policy_template, folder / "out", folder / "cache",
            "--max-drop", "100%", "--episodes", "10", "--every-candidate", "--json",
        )  # fmt: skip
    assert run.code == 0, run.stderr
    return run


@pytest.fixture
def model(policy_dir, float_bundle) -> Path:
    """An ONNX file with its description and data beside it."""
    return Path(shutil.copyfile(float_bundle.path / "graphs/main.onnx", policy_dir / "tiny.onnx"))


@pytest.fixture
def recipe(tmp_path):
    def write(text: str) -> list[Any]:
        (tmp_path / "recipe.yaml").write_text(text)
        return ["--recipe", tmp_path / "recipe.yaml"]

    return write


@pytest.fixture(scope="session")
def shared_cache(tmp_path_factory) -> Path:
    """A cache that the runs of several tests add to."""
    return tmp_path_factory.mktemp("optimize") / "cache"


@pytest.fixture
def no_explanation(monkeypatch) -> None:
    """Runs that have no sentences on what takes the time; ``from_torch`` has them."""
    monkeypatch.setattr("vlatool.optimize.pipeline.explanation_in_child", lambda *_, **__: ())


@pytest.fixture
def run(model, tmp_path, shared_cache, no_explanation):
    """Optimize the ONNX file; what another test has made or measured is not made again."""
    numbers = iter(range(99))
    return lambda *more: optimize(model, tmp_path / f"out{next(numbers)}", shared_cache, *more)


@pytest.fixture
def run_apart(model, tmp_path, no_explanation):
    """Optimize the ONNX file; every run of the test shares one cache, and no other test has it."""
    numbers = iter(range(99))
    return lambda *more: optimize(model, tmp_path / f"out{next(numbers)}", tmp_path / "cache", *more)


@pytest.fixture(scope="session")
def dynamic_once(policy_template, float_bundle, tmp_path_factory) -> Run:
    """A run with one candidate and the nearest kept; read only."""
    folder = tmp_path_factory.mktemp("dynamic")
    shutil.copytree(policy_template, folder / "tiny")
    model = shutil.copyfile(float_bundle.path / "graphs/main.onnx", folder / "tiny/tiny.onnx")
    (folder / "recipe.yaml").write_text(DYNAMIC)
    made = optimize(model, folder / "out", folder / "cache", *NEAREST, "--recipe", folder / "recipe.yaml")
    made.cache.rename(folder / "kept")
    return made


@pytest.fixture
def first(dynamic_once) -> Iterator[Run]:
    """The same with its cache, which the test may change."""
    shutil.copytree(dynamic_once.cache.with_name("kept"), dynamic_once.cache)
    yield dynamic_once
    shutil.rmtree(dynamic_once.cache)


@pytest.fixture
def run_again(first, tmp_path, no_explanation):
    """Optimize the ONNX file of ``first`` with its cache."""
    return lambda *more: optimize(first.out.parent / "tiny/tiny.onnx", tmp_path / "again", first.cache, *more)


def stamps(cache: Path) -> dict[str, tuple[int, int]]:
    return {
        path.relative_to(cache).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in cache.rglob("*")
        if path.is_file()
    }


def graph(bundle: Path) -> bytes:
    return (bundle / "graphs/main.onnx").read_bytes()


# ---- from torch


def test_the_result_is_a_bundle_that_a_robot_loads(from_torch):
    opened = Bundle.open(from_torch.out)
    policy = load(from_torch.out, threads=1)
    observation = {"image": np.zeros((8, 8, 3), np.uint8), "proprio": np.zeros(3, np.float32), "instruction": "go"}
    assert policy.infer(observation).chunk.shape == (4, 2)
    assert opened.manifest.parent.startswith("sha256:")
    assert opened.manifest.made_by["profile"] == "raspberry-pi-5"
    assert opened.manifest.source == {}


def test_recorded_data_stays_behind(from_torch):
    found = {path.name for path in from_torch.out.iterdir()}
    beside = {"manifest.json", "manifest.sha256", ".written-by-vlatool.json", "recipe.yaml"}
    assert found == {"assets", "golden", "graphs", "reports", *beside}
    assert {path.name for path in (from_torch.out / "reports").iterdir()} == {
        "report.json",
        "report.html",
        "report.md",
    }
    assert not any(name.startswith("data/") for name in Bundle.open(from_torch.out).manifest.files)


def test_nothing_but_the_reports_names_a_place_of_this_machine(from_torch, policy_template):
    places = [str(policy_template), str(from_torch.cache), str(from_torch.out.parent)]
    places += ["site-packages", str(Path(__file__).parents[2])]
    for path in from_torch.out.rglob("*"):
        if path.is_file() and "reports" not in path.parts:
            found = [place for place in places if place.encode() in path.read_bytes()]
            assert found == [], f"{path.name} names {found}"


def test_json_is_all_that_is_printed_and_equals_the_report_on_disk(from_torch):
    printed = json.loads(from_torch.stdout)
    kept = json.loads((from_torch.out / "reports/report.json").read_text())
    assert printed.pop("raw_samples")["file"] == str(from_torch.out / "reports/report.json")
    assert printed == {**kept, "rows": [{**row, "raw": {}} for row in kept["rows"]]}, "all but the raw samples"
    assert Report.from_json(from_torch.stdout).kind == "optimize"


def test_every_candidate_has_a_row_with_what_was_measured_and_predicted(from_torch):
    report = from_torch.report
    names = [row.name for row in report.rows]
    assert names[:3] == ["float32", "dynamic_int8", "static_int8"]
    chosen = next(row for row in report.rows if row.role == "chosen")
    plans = {trial["plan"]: trial for trial in chosen.details["Plans tried by the search"]}
    assert set(names[1:]) <= set(plans), "which options win on a policy of four layers depends on the processor"
    assert all(plans[name]["speed-up"] for name in names[1:])
    assert [row.role for row in report.rows].count("chosen") == 1
    assert report.verdict == "pass"
    assert "float32 succeeds in 80.0% of 10 episodes; actions that do not look" in report.summary[-1]
    assert "Whether the reference does its task" in report.rows[0].details
    assert report.limits["profile"] == "raspberry-pi-5"
    assert report.command.startswith("vlatool")
    assert report.created
    assert report.environment["cpu"]
    for row in report.rows:
        assert row.reason
        assert row.get("latency_p50").samples == len(row.raw["latency_ms"]) == 20
        assert row.get("latency_p50", "predicted").where == "raspberry-pi-5"
        assert row.get("memory", "predicted") is not None
        assert row.value("peak_rss") > 0
        assert row.get("error_expert.dx").unit == "m"


def test_the_baseline_also_says_how_fast_eager_torch_is(from_torch):
    found = [row.get("torch_eager_latency_p50") for row in from_torch.report.rows]
    assert found[0].samples == 20
    assert set(found[1:]) == {None}


def test_episodes_are_paired_with_those_of_float32(from_torch):
    base, *candidates = from_torch.report.rows
    assert base.get("success").samples == 10
    for row in candidates:
        assert row.raw["seed"] == base.raw["seed"]
        assert row.value("success_drop") == 0.0
        assert row.details["paired with the baseline"][0]["episodes"] == 10


def test_the_manifest_holds_the_accuracy_of_what_was_chosen(from_torch):
    chosen = next(row for row in from_torch.report.rows if row.role == "chosen")
    accuracy = Bundle.open(from_torch.out).manifest.accuracy
    assert accuracy["success"] == {
        "value": chosen.value("success"),
        "low": chosen.get("success").low,
        "high": chosen.get("success").high,
        "samples": 10,
    }
    assert accuracy["error_expert"]["value"] == chosen.value("error_expert")


def test_progress_goes_to_stderr(from_torch):
    for step in ("export.onnx", "quantize.static_int8", "measuring latency", "episodes"):
        assert step in from_torch.stderr


def test_a_metric_that_is_not_measured_is_refused_before_the_search(run):
    wrong = run("--max-drop", "relative_eror=0.1")
    assert wrong.code == 3
    assert "did you mean 'relative_error'" in wrong.stderr
    assert "quantize" not in wrong.stderr
    assert not wrong.out.exists()


def test_a_metric_without_observations_is_refused_before_the_search(model, tmp_path):
    for name in ("evaluation.npz", "calibration.npz"):
        (model.parent / name).unlink()
    wrong = optimize(model, tmp_path / "out", tmp_path / "cache", "--max-drop", "relative_error=0.1")
    assert wrong.code == 3
    assert "needs recorded observations" in wrong.stderr
    assert "quantize" not in wrong.stderr


def test_the_summary_says_which_engine_the_robot_needs(run, recipe):
    options = "".join(f", {name}: true" for name in full_range_or_less())
    mine = recipe(f"candidates: {{mine: [quantize.static_int8: {{samples: 8, layout: openvino{options}}}]}}")
    needs = "It runs on the engine openvino: pip install 'vlatool-runtime[openvino]' on the robot."
    assert needs in run(*NEAREST, *mine).report.summary


# ---- repeat


def test_the_recipe_of_the_result_makes_the_same_graphs_again_without_the_cache(run, recipe, model, tmp_path):
    first = run(*NEAREST, *recipe(STATIC))
    assert first.code == 1
    written = read_recipe(first.out / "recipe.yaml")
    assert list(written.candidates) == ["mine"]
    again = optimize(model, tmp_path / "again", tmp_path / "other", *NEAREST, "--recipe", first.out / "recipe.yaml")
    assert Bundle.open(again.out).manifest.made_by["candidate"] == "mine"
    assert graph(again.out) == graph(first.out)
    assert (again.out / "manifest.json").read_bytes() == (first.out / "manifest.json").read_bytes()
    assert (again.out / "recipe.yaml").read_bytes() == (first.out / "recipe.yaml").read_bytes()


def test_a_second_run_writes_nothing_new_into_the_cache(first, run_again, recipe):
    before = stamps(first.cache)
    second = run_again(*NEAREST, *recipe(DYNAMIC))
    assert stamps(first.cache) == before
    assert (second.out / "manifest.json").read_bytes() == (first.out / "manifest.json").read_bytes()
    assert [row.raw for row in second.report.rows] == [row.raw for row in first.report.rows]


def test_fresh_measures_again_and_keeps_what_was_made(first, run_again, recipe):
    before = stamps(first.cache)
    assert run_again(*NEAREST, *recipe(DYNAMIC), "--fresh").row("mine").raw != first.row("mine").raw
    after = stamps(first.cache)
    changed = {name.split("/")[1].rpartition("-")[0] for name in after if after[name] != before.get(name)}
    assert changed == {"benchmark.latency"}


@pytest.mark.parametrize(
    ("stage", "file"),
    [
        ("quantize.dynamic_int8", "graphs/main.onnx"),
        ("benchmark.latency", "report.json"),
        *small_or_full([], [("sources.onnx", "manifest.json"), ("evaluate.recorded", "report.json")]),
    ],
)
def test_a_damaged_entry_of_the_cache_is_made_again(first, run_again, recipe, stage, file):
    (damaged, *_rest) = sorted(first.cache.glob(f"stages/{stage}-*/{file}"))
    damaged.write_bytes(damaged.read_bytes()[:-20])
    second = run_again(*NEAREST, *recipe(DYNAMIC))
    assert second.code == first.code
    assert f"the cached {stage} is damaged" in second.stderr
    assert (second.out / "manifest.json").read_bytes() == (first.out / "manifest.json").read_bytes()
    if stage.startswith(("quantize", "sources")):
        Bundle.open(damaged.parents[file.count("/")])


def test_an_option_of_one_candidate_leaves_the_others_in_the_cache(first, run_again, recipe):
    before = stamps(first.cache)
    run_again(*NEAREST, *recipe(DYNAMIC.replace("{}", "{per_channel: false}")))
    assert {name: stamp for name, stamp in stamps(first.cache).items() if name in before} == before


# ---- verdicts


def test_a_candidate_outside_the_budget_is_kept_as_the_nearest_with_exit_status_1(run, recipe, model):
    with np.load(model.parent / "evaluation.npz") as data:
        kept = {name: data[name] for name in data.files if name != "action"}
    np.savez(model.parent / "evaluation.npz", **kept)
    made = run("--max-drop", "0", "--episodes", "0", *recipe(BAD))
    assert made.code == 1
    assert made.report.verdict == "fail"
    assert made.row("bad").role == "chosen"
    assert "outside the limits" in made.row("bad").reason
    assert made.report.summary[0].startswith("No candidate keeps to the limits; the nearest, bad, was kept. It is ")
    assert "Predicted for raspberry-pi-5, not measured there: " in made.report.summary[0]
    assert "error: No candidate keeps to the limits" in made.stderr
    assert Bundle.open(made.out).manifest.made_by["candidate"] == "bad"


def test_a_reference_that_does_not_do_its_task_is_inconclusive(run, recipe, model):
    """Success unchanged at 0 % is no pass; nor is an agreement with an expert that a constant reaches."""
    with np.load(model.parent / "evaluation.npz") as stored:
        data = {name: stored[name] for name in stored.files}
    np.savez(model.parent / "evaluation.npz", **data | {"action": data["action"][::-1]})
    wrong = run("--max-drop", "100%", *recipe(DYNAMIC))
    assert wrong.code == 5
    assert wrong.report.verdict == "inconclusive"
    assert wrong.report.summary[0].startswith("The reference fails, so that nothing can be held against it: float32")
    world = model.parent / "environment.py"
    world.write_text(world.read_text().replace('"success": done and good', '"is_success": False'))
    none = run("--max-drop", "100%", "--episodes", "4", *recipe(DYNAMIC))
    assert none.code == 5
    assert "float32 succeeds in none of 4 closed-loop episodes" in none.report.summary[0]
    assert "PASS" not in none.stdout


def test_a_distance_that_is_not_allowed_is_outside(run, recipe):
    made = run("--max-drop", "100%", "--max-distance", "0.0001%", *recipe(DYNAMIC))
    assert made.code == 1
    assert "of its standard deviation, allowed 0.0001 % (--max-distance)" in made.row("mine").reason
    assert made.report.limits["max_distance_percent"] == pytest.approx(0.0001)
    assert run("--max-distance", "far").code == 2


def test_without_any_accuracy_nothing_is_inside(run, recipe, model):
    for name in ("evaluation.npz", "calibration.npz"):
        (model.parent / name).unlink()
    made = run("--max-drop", "100%", *recipe(DYNAMIC))
    assert (made.code, made.report.verdict) == (1, "fail")
    assert made.row("float32").role == "chosen"
    assert "its accuracy is unmeasured" in made.row("mine").reason


def test_with_calibration_data_alone_the_error_against_float32_on_a_held_out_half_is_the_accuracy(
    run_apart, recipe, model, tmp_path
):
    (model.parent / "evaluation.npz").unlink()
    with np.load(model.parent / "calibration.npz") as data:
        kept = {name: data[name] for name in data.files if name != "action"}
    np.savez(model.parent / "calibration.npz", **kept)
    asked = recipe("candidates: {mine: [quantize.static_int8: {}]}")
    made = run_apart("--max-drop", "100%", "--max-distance", "100%", "--no-search", *asked)
    assert made.code == 0, made.stderr
    row = made.row("mine")
    assert row.get("error_baseline").samples == 12
    assert "the action differs from float32's by" in row.reason
    assert any("12 of the 24 observations for calibration, held out of it" in told for told in made.report.warnings)
    assert "error vs baseline" in made.stdout
    (bundle,) = (tmp_path / "cache" / "stages").glob("quantize.static_int8-*")
    assert Bundle.open(bundle).manifest.made_by["calibration"]["samples"] == 12


def test_a_candidate_that_cannot_be_made_is_a_row_that_says_why(run, recipe):
    made = run("--max-drop", "100%", *recipe(MISSING))
    assert made.code == 0
    assert (made.row("lost").role, "not found" in made.row("lost").reason) == ("failed", True)
    assert "vlatool" in made.stdout or "PASS" in made.stdout


def test_the_terminal_report_ends_with_where_things_are(run, recipe):
    made = run("--max-drop", "100%", *recipe(DYNAMIC))
    assert made.stdout.startswith("PASS")
    assert f"bundle: {made.out}\n" in made.stdout
    assert made.stdout.endswith(f"report: {made.out / 'reports' / 'report.html'}\n")


def test_a_bundle_that_exists_is_replaced_with_force(recipe, model, tmp_path, shared_cache):
    mine = recipe(DYNAMIC)
    (tmp_path / "out").mkdir()
    refused = optimize(model, tmp_path / "out", tmp_path / "cache", *mine)
    assert (refused.code, list(refused.out.iterdir())) == (3, [])
    assert not refused.cache.exists()
    assert optimize(model, tmp_path / "out", shared_cache, *mine, *NEAREST, "--force").code == 1
    Bundle.open(tmp_path / "out")


# ---- plans


def plan(capsys, source: Path, tmp_path: Path, *more: Any) -> list[str]:
    line = ["optimize", source, "-o", tmp_path / "out", "--cache", tmp_path / "cache", "--dry-run", *more]
    with pytest.raises(SystemExit) as left:
        main([str(part) for part in line])
    assert left.value.code == 0
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "cache").exists()
    return capsys.readouterr().out.splitlines()


def test_a_dry_run_prints_the_plan_and_runs_nothing(capsys, policy_template, tmp_path):
    lines = plan(capsys, policy_template, tmp_path, "--profile", "raspberry-pi-5", "--hz", "5", "--max-drop", "2%")
    kinds = [line.split()[0] for line in lines]
    told = ["benchmark", "evaluate", "search", "limits", "profile", "cache"]
    assert kinds == ["source", "export", "candidate", "candidate", *told]
    text = "\n".join(lines)
    assert "quantize.dynamic_int8" in text
    assert "drop <= 2 points, 5 Hz" in text
    assert "200 paired closed-loop episodes" in text


def test_without_episodes_the_plan_has_no_closed_loop(capsys, policy_template, tmp_path):
    lines = plan(capsys, policy_template, tmp_path, "--profile", "raspberry-pi-5", "--episodes", "0")
    assert not [line for line in lines if "closed-loop" in line]


def test_a_board_with_another_engine_gets_standard_operators(capsys, policy_template, tmp_path):
    lines = plan(capsys, policy_template, tmp_path, "--profile", "jetson-orin-nano")
    candidates = [line for line in lines if line.startswith("candidate")]
    assert candidates
    assert all("layout=qdq activations=int8" in line or "activations=int8 layout=qdq" in line for line in candidates)


def test_without_calibration_data_only_dynamic_quantization_is_planned(capsys, model, tmp_path):
    (model.parent / "calibration.npz").unlink()
    lines = plan(capsys, model, tmp_path, "--profile", "raspberry-pi-5")
    assert [line for line in lines if line.startswith("candidate")] == [
        "candidate   dynamic_int8: quantize.dynamic_int8"
    ]


def test_limits_and_effort_of_a_recipe_hold_unless_the_command_line_says_otherwise(
    capsys, policy_template, recipe, tmp_path
):
    given = recipe(DYNAMIC + "\nlimits: {max_drop: 0.5, hz: 7}\neffort: {episodes: 30, iterations: 40, threads: 2}")
    text = "\n".join(plan(capsys, policy_template, tmp_path, "--profile", "raspberry-pi-5", *given))
    assert "40 inferences of each, interleaved, 2 thread(s)" in text
    assert "30 paired closed-loop episodes" in text
    assert "drop <= 50 points, 7 Hz" in text
    changed = ["--max-drop", "3%", "--hz", "9", "--episodes", "12"]
    text = "\n".join(plan(capsys, policy_template, tmp_path, "--profile", "raspberry-pi-5", *given, *changed))
    assert "drop <= 3 points, 9 Hz" in text
    assert "12 paired closed-loop episodes" in text


# ---- sources


def test_what_may_be_typed_as_source(policy_dir, model):
    for typed in (policy_dir, policy_dir / "policy.yaml"):
        stage = source_stage(str(typed))
        assert isinstance(stage, TorchModule)
        assert stage.policy == typed
    stage = source_stage(f"{policy_dir / 'policy.py'}:make")
    assert isinstance(stage, TorchModule)
    assert (stage.factory, stage.policy) == ("policy.py:make", policy_dir)
    stage = source_stage(str(model))
    assert isinstance(stage, OnnxFile)
    assert stage.policy == policy_dir / "policy.yaml"
    (policy_dir / "policy.yaml").unlink()
    stage = source_stage(str(model))
    assert isinstance(stage, OnnxFile)
    assert stage.policy is None


@pytest.mark.parametrize("typed", ["nothing", "none.py:make", "policy.py", "a:b"])
def test_what_may_not_be_typed_as_source(typed):
    with pytest.raises(SourceError):
        source_stage(typed)


def test_an_onnx_file_with_an_environment_beside_it_plays_the_closed_loop(model, tmp_path):
    recipe = default_recipe(Limits(), Effort(episodes=8), calibrated=True)
    made = make_plan(str(model), load_profile("raspberry-pi-5"), recipe, tmp_path)
    assert made.closed_loop is not None
    assert made.closed_loop.episodes == 8


def test_the_limit_on_calls_of_an_environment_reaches_the_episodes(model, tmp_path):
    recipe = default_recipe(Limits(), Effort(episodes=8, environment_timeout=7), calibrated=True)
    made = make_plan(str(model), load_profile("raspberry-pi-5"), recipe, tmp_path)
    assert made.closed_loop is not None
    assert made.closed_loop.environment_timeout == 7


def test_calibration_data_is_found_beside_the_description(policy_dir, model):
    assert brings_calibration(source_stage(str(policy_dir)))
    assert brings_calibration(source_stage(str(model)))
    (policy_dir / "calibration.npz").unlink()
    assert not brings_calibration(source_stage(str(policy_dir)))
    (policy_dir / "policy.yaml").unlink()
    assert not brings_calibration(source_stage(str(model)))


def test_a_source_with_graphs_is_not_exported_again(model, tmp_path):
    stage = source_stage(str(model))
    source = source_bundle(stage, tmp_path, Context())
    assert with_graphs(source, tmp_path, Context()) == source
    assert list(source.bundle.manifest.graphs) == ["main"]


@pytest.mark.parametrize(
    ("candidates", "says"),
    [
        ({"float32": ({"quantize.dynamic_int8": {}},)}, "cannot be called 'float32'"),
        ({"a/b": ({"quantize.dynamic_int8": {}},)}, "cannot be called 'a/b'"),
        ({"a": ({"evaluate.recorded": {}},)}, "evaluate.recorded measures"),
        ({"a": ({"quantize.dynamic_int8": {"x": 1}},)}, "unknown option 'x'"),
    ],
)
def test_a_plan_is_checked_whole_before_anything_runs(candidates: Any, says: str, policy_template, tmp_path):
    recipe = default_recipe(Limits(), Effort(), calibrated=True).model_copy(update={"candidates": candidates})
    with pytest.raises(RecipeError, match=says):
        make_plan(str(policy_template), load_profile("raspberry-pi-5"), recipe, tmp_path)
    assert list(tmp_path.iterdir()) == []


def _names(rows: Sequence[Any]) -> list[str]:
    return [row.name for row in rows]


def test_the_rows_of_a_run_begin_with_float32(run, recipe):
    assert _names(run("--max-drop", "100%", *recipe(DYNAMIC)).report.rows) == ["float32", "mine"]
