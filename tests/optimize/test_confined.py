"""``optimize`` for a board whose set OpenVINO is confined to, end to end: AVX2 on a host with more.

int8 products of full-range activations saturate in AVX2 and are exact with VNNI, so that both sets show in the errors.
The process of these tests may have loaded OpenVINO unconfined, as a library's user would have.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from _full import small_or_full
from _processes import environment_at_start

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.hardware.profile import load_profile
from vlatool.machine import instruction_sets
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.machine.instruction_sets import rung
from vlatool.machine.processes import python_code
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.report import Report, Row, read_report
from vlatool.runtime import load
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.user_code import children

HOST = rung(instruction_sets.isa() or ())
SHOWS = pytest.mark.needs("more than avx2", reason="figures of the host and of a board with AVX2 differ")
RECIPE = """\
candidates:
  ours: [quantize.dynamic_int8: {}]
  full: [quantize.static_int8: {samples: 8, layout: openvino}]
  reduced: [quantize.static_int8: {samples: 8, layout: openvino, reduce_range: true}]
limits: {max_drop: 1.0, max_distance: 100, accept: [engine-difference]}
effort: {episodes: 4, iterations: 20}
"""


@pytest.fixture(scope="session")
def old_nuc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A profile of a board with AVX2 alone."""
    text = (Path(__file__).parents[2] / "profiles/intel-nuc-13-pro.yaml").read_text(encoding="utf-8")
    text = text.replace("name: intel-nuc-13-pro", "name: old-nuc").replace(", avx_vnni]", "]")
    path = tmp_path_factory.mktemp("profiles") / "old-nuc.yaml"
    path.write_text(text.replace('"i7-1360P", "NUC13ANH", "NUC13ANK"', '"i5-7260U"'), encoding="utf-8")
    assert rung(load_profile(path).units["cpu"].isa) == "AVX2"
    return path


def optimize(source: Path, out: Path, cache: Path, recipe: Path, *more: object) -> Report:
    recipe.write_text(RECIPE, encoding="utf-8")
    line = [
        "optimize",
        source,
        "-o",
        out,
        "--cache",
        cache,
        "--recipe",
        recipe,
        "--workers",
        "1",
        "--json",
        "--raw",
        *more,
    ]
    with contextlib.redirect_stdout(io.StringIO()) as told, contextlib.suppress(SystemExit):
        main([str(part) for part in line])
    report = read_report(out)
    printed = json.loads(told.getvalue())
    printed.pop("error", None)  # how the command ended
    assert printed == json.loads(report.to_json()), "what is printed is what was written, also by another process"
    return report


@pytest.fixture(scope="session")
def runs(policy_template: Path, old_nuc: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Report]:
    """The tiny policy for this host, and for a board with AVX2 alone, in one cache; read only."""
    pytest.importorskip("openvino")
    folder = tmp_path_factory.mktemp("confined")
    source = Path(shutil.copytree(policy_template, folder / "tiny"))
    common = (folder / "cache", folder / "recipe.yaml")
    host, call = optimize(source, folder / "host", *common), children.call
    quick = small_or_full({"preload": ("_without_cold_starts",)}, {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(children, "call", lambda *job, **more: call(*job, **quick, **more))
        return {"host": host, "board": optimize(source, folder / "board", *common, "--profile", old_nuc)}


def row(report: Report, name: str) -> Row:
    return next(each for each in report.rows if each.name == name)


@SHOWS
def test_the_errors_are_those_of_the_boards_set(runs):
    host, board = (row(runs[name], "full").value("error_baseline") for name in ("host", "board"))
    assert board > 2 * host, "full-range products saturate in AVX2 alone"
    kept = [row(runs[name], "reduced").value("error_baseline") for name in ("host", "board")]
    assert kept[0] == pytest.approx(kept[1], rel=0.2), "products of 7 bits are the same in both"


@SHOWS
def test_onnx_runtime_is_not_confined(runs):
    errors = [row(runs[name], "ours").value("error_baseline") for name in ("host", "board")]
    assert errors[0] == errors[1]


@SHOWS
def test_figures_say_what_they_are_ratios_of_and_where_they_were_taken(runs):
    board = runs["board"]
    assert board.environment["onednn_max_cpu_isa"] == "AVX2"
    assert runs["host"].environment["onednn_max_cpu_isa"] is None
    for name in ("full", "reduced"):
        found = row(board, name)
        measured = [each for each in found.measurements if each.origin == "measured"]
        assert {each.where for each in measured} == {"this host, OpenVINO confined to AVX2"}
        assert "float32 in OpenVINO" in found.get("speedup").note
        assert "(AVX2), on another core" in found.get("speedup").note
    assert row(board, "float32").get("openvino_float32_latency_p50").where == "this host, OpenVINO confined to AVX2"
    assert row(board, "ours").get("latency_p50").where == "this host"
    assert "float32 in ONNX Runtime" in row(board, "ours").get("speedup").note


@SHOWS
def test_the_summary_says_which_set_and_that_int8_may_lose(runs):
    said = " ".join(runs["board"].summary)
    assert "OpenVINO was confined to AVX2, the instruction set of old-nuc" in said
    assert "old-nuc has no VNNI" in said
    assert "no ratio between the two engines is given" in said
    assert "confined" not in " ".join(runs["host"].summary)


@SHOWS
def test_eager_torch_is_left_out_since_it_would_be_confined_in_part(runs):
    assert row(runs["host"], "float32").get("torch_eager_latency_p50") is not None
    assert row(runs["board"], "float32").get("torch_eager_latency_p50") is None


@SHOWS
def test_the_cache_keeps_both_sets_apart_and_exports_once(runs, tmp_path_factory):
    folder = next(Path(tmp_path_factory.getbasetemp()).glob("confined*"))
    stages = [path.name.rpartition("-")[0] for path in (folder / "cache/stages").iterdir()]
    assert stages.count("export.onnx") == 1
    assert stages.count("quantize.static_int8") == 4, "two candidates in two sets"
    made = [Bundle.open(path) for path in (folder / "cache/stages").glob("quantize.static_int8-*")]
    full = [each for each in made if not each.manifest.made_by["options"].get("reduce_range")]
    names = [[finding["name"] for finding in each.manifest.findings] for each in full]
    assert sorted(names) == [[], ["engine-difference"]], "the engine is off its graphs in AVX2 alone"
    (finding,) = (finding for each in full for finding in each.manifest.findings)
    assert "on this machine (OpenVINO confined to AVX2 by ONEDNN_MAX_CPU_ISA): relative" in finding["message"]


@SHOWS
def test_no_run_times_both_engines_where_one_is_confined(runs, tmp_path_factory):
    folder = next(Path(tmp_path_factory.getbasetemp()).glob("confined*"))
    timed = [read_report(path) for path in (folder / "cache/stages").glob("benchmark.latency-*")]
    engines: dict[str | None, list[list[str]]] = {"AVX2": [], None: []}
    for report in timed:
        found = [each["engine"] for each in (table for row in report.rows for table in row.details.get("engine", ()))]
        engines[report.environment["onednn_max_cpu_isa"]].append(found)
    assert sorted(engines["AVX2"]) == [["openvino"] * 3, ["ort_cpu"] * 2]
    assert engines[None] == [["ort_cpu", "ort_cpu", "openvino", "openvino"]]


@SHOWS
def test_the_result_is_a_bundle_that_loads(runs, tmp_path_factory):
    folder = next(Path(tmp_path_factory.getbasetemp()).glob("confined*"))
    assert load(folder / "board").bundle.manifest.made_by["profile"] == "old-nuc"


def test_a_child_has_the_variable_from_its_start_and_its_server_too(monkeypatch: pytest.MonkeyPatch):
    """Its server as well: a library that was loaded before the fork has read the variable."""
    monkeypatch.delenv(MAX_CPU_ISA, raising=False)
    for environment, isa in (({MAX_CPU_ISA: "AVX2"}, "AVX2"), (None, None)):
        before = dict(children._servers)
        with children.Child("policy.py", environment=environment):
            key = next(kind for kind in children._servers if kind[0] == str(os.getpid()) and kind[-1] == (isa or ""))
            variables = environment_at_start(children._servers[key].process.pid)
        assert variables.get(MAX_CPU_ISA) == isa
        assert set(before) <= set(children._servers), "servers of other sets stay"
    assert MAX_CPU_ISA not in os.environ, "the parent computes as before"


def test_what_a_confined_child_raises_is_the_users_error(old_nuc: Path, policy_dir: Path, tmp_path: Path, capsys):
    pytest.importorskip("openvino")
    (policy_dir / "policy.py").write_text("raise RuntimeError('broken on purpose')\n")
    with pytest.raises(SystemExit) as left:
        main(["optimize", str(policy_dir), "-o", str(tmp_path / "out"), "--profile", str(old_nuc)])
    assert left.value.code == 3
    assert "broken on purpose" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def evaluate(bundle: Path, *more: object) -> int:
    with pytest.raises(SystemExit) as left:
        main(["evaluate", "recorded", str(bundle), *map(str, more)])
    return int(left.value.code or 0)


@SHOWS
def test_what_evaluates_a_bundle_for_a_board_does_so_in_its_set(float_bundle, old_nuc, tmp_path: Path, capsys):
    pytest.importorskip("openvino")
    made = StaticInt8(samples=8, layout="openvino", reduce_range=True)
    bundle = run_transform(made, float_bundle, tmp_path / "made", Context()).bundle
    for path, told in ((bundle.path, "AVX2"), (float_bundle.path, None)):
        assert evaluate(path, "--profile", old_nuc, "--json") == 0
        report = Report.from_json(capsys.readouterr().out)
        assert report.environment["onednn_max_cpu_isa"] == told, "ONNX Runtime cannot be confined"
        said = "OpenVINO was confined to AVX2, the instruction set of old-nuc: its answers are of that set."
        assert (said in report.summary) is (told is not None)


@SHOWS
def test_a_bundle_that_the_board_computes_otherwise_is_refused_when_it_is_evaluated_for_it(
    float_bundle, old_nuc, tmp_path: Path, capsys
):
    pytest.importorskip("openvino")
    bundle = run_transform(StaticInt8(samples=8, layout="openvino"), float_bundle, tmp_path / "made", Context()).bundle
    assert evaluate(bundle.path) == 0
    assert evaluate(bundle.path, "--profile", old_nuc) == 3
    told = capsys.readouterr().err
    assert "a different golden action than recorded" in told
    assert "OpenVINO confined to AVX2" in told
    assert "this processor" not in told, "it has more than AVX2"


@SHOWS
def test_openvino_itself_obeys_the_variable_of_a_child():
    """What all of this rests on; asked of a product that saturates."""
    pytest.importorskip("openvino")
    code = "from vlatool.runtime.engines.openvino import OpenvinoSession as o; print(o.arithmetic()[:5])"
    environment = {**os.environ, MAX_CPU_ISA: "AVX2"}
    done = subprocess.run(python_code(code), env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "satur"


def lines(capsys, source: Path, profile: Path | str) -> list[str]:
    with contextlib.suppress(SystemExit):
        main(["optimize", str(source), "-o", "unused", "--profile", str(profile), "--dry-run"])
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("computes")]


def test_the_plan_says_what_will_be_computed_in(monkeypatch, capsys, policy_template: Path, old_nuc: Path):
    pytest.importorskip("openvino")
    monkeypatch.delenv(MAX_CPU_ISA, raising=False)
    monkeypatch.setattr(instruction_sets, "isa", lambda: ["avx2", "avx512f", "avx512_vnni"])
    monkeypatch.setattr(instruction_sets, "fingerprint", lambda: {"cpu": "none of a profile"})
    (line,) = lines(capsys, policy_template, old_nuc)
    assert line.endswith("OpenVINO confined to AVX2, in a process of its own; ONNX Runtime as this host is")
    (line,) = lines(capsys, policy_template, "intel-nuc-13-pro")
    assert line.endswith("OpenVINO in AVX512_CORE_VNNI; intel-nuc-13-pro has AVX2_VNNI")
    assert lines(capsys, policy_template, "raspberry-pi-5") == []


def test_a_host_that_lacks_the_set_computes_as_it_is_and_the_report_warns(
    monkeypatch, float_bundle: Bundle, policy_dir: Path, tmp_path: Path
):
    """The flags are planted: this host can be anything."""
    pytest.importorskip("openvino")
    monkeypatch.delenv(MAX_CPU_ISA, raising=False)
    monkeypatch.setattr(instruction_sets, "isa", lambda: ["avx2", "avx512f", "avx512_vnni"])
    monkeypatch.setattr(instruction_sets, "fingerprint", lambda: {"cpu": "none of a profile"})
    recipe = tmp_path / "recipe.yaml"
    few = RECIPE.replace("episodes: 4", "episodes: 0").splitlines()
    recipe.write_text("\n".join(line for line in few if not line.startswith(("  full", "  reduced"))))
    model = shutil.copyfile(float_bundle.path / "graphs/main.onnx", policy_dir / "tiny.onnx")
    line = ["optimize", model, "-o", tmp_path / "out", "--recipe", recipe, "--profile", "intel-nuc-13-pro"]
    with contextlib.suppress(SystemExit):
        main([str(part) for part in line])
    report = read_report(tmp_path / "out")
    assert report.environment["onednn_max_cpu_isa"] is None
    (warning,) = [each for each in report.warnings if "cannot be confined" in each]
    assert "its processor has no avx_vnni" in warning
    assert not any("confined to" in each for each in report.summary)
    assert {each.where for each in report.rows[-1].measurements if each.origin == "measured"} == {"this host"}
