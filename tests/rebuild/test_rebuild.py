"""A bundle is made again from its record: what the record holds, what may stand in the way, and what differs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool import __version__
from vlatool.bundle.bundle import DIGEST, Bundle, digest_of, hash_file, seal
from vlatool.data import recorded_observations
from vlatool.errors import BundleError, SourceError, VlatoolError
from vlatool.export.onnx import ExportOnnx
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.rebuild.differences import FileMatch, compare_bundles, explain, name_list
from vlatool.rebuild.rebuild import RebuildResult, build_record, rebuild, version_changes
from vlatool.report import Report
from vlatool.sources import source_stage
from vlatool.sources.onnx import OnnxFile
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.finish import history, save_npz
from vlatool.stage.record import SampleSet, input_hashes
from vlatool.stage.run import cached_transform, run_transform

QUIET = Context()
GRAPH = "graphs/main.onnx"


@pytest.fixture(scope="module")
def onnx_policy(float_bundle: Bundle, policy_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ONNX file with a description beside it; read only."""
    folder = tmp_path_factory.mktemp("onnx") / "tiny"
    shutil.copytree(policy_template, folder)
    shutil.copyfile(float_bundle.path / GRAPH, folder / "tiny.onnx")
    return folder


@pytest.fixture(scope="module")
def dynamic_bundle(onnx_policy: Path, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """Dynamic int8 of the ONNX file, which takes no torch to make again; read only."""
    folder = tmp_path_factory.mktemp("dynamic")
    source = run_transform(
        OnnxFile(model=onnx_policy / "tiny.onnx", policy=onnx_policy), None, folder / "s", QUIET
    ).bundle
    return run_transform(DynamicInt8(per_channel=False), source, folder / "bundle", QUIET).bundle


@pytest.fixture
def again(tmp_path: Path):
    """Make a bundle again."""

    def run(bundle: Bundle, source: Path | str | None = None, **settings: Any) -> RebuildResult:
        settings.setdefault("cache", tmp_path / "empty_cache")
        return rebuild(bundle, QUIET, source=None if source is None else str(source), **settings)

    return run


# ---- the record


def test_the_record_is_the_chain_from_the_source(int8_bundle, float_bundle, source_bundle, policy_template):
    source, export, quantize = int8_bundle.manifest.build
    assert [entry["stage"] for entry in (source, export, quantize)] == [
        "sources.torch_module",
        "export.onnx",
        "quantize.static_int8",
    ]
    assert (export["input"], quantize["input"]) == (source_bundle.hash, float_bundle.hash)
    for entry, bundle in ((export, float_bundle), (quantize, int8_bundle)):
        assert entry["graphs"] == {GRAPH: hash_file(bundle.path / GRAPH)}
        assert entry["seed"] == 0
        assert entry["versions"]["onnx"]
    for name in ("policy.py", "policy.yaml", "weights.safetensors", "calibration.npz", "vocabulary.json"):
        assert source["files"][name] == hash_file(policy_template / name)
    assert source["factory"] == "policy.py:make"
    assert history(source_bundle) == (source,)
    assert int8_bundle.manifest.build == history(int8_bundle)
    assert Bundle.open(int8_bundle.path).manifest == int8_bundle.manifest


def test_the_record_holds_the_calibration_samples(int8_bundle, float_bundle):
    samples = SampleSet()
    used = list(samples.watch(recorded_observations(float_bundle, StaticInt8().samples)))
    assert int8_bundle.manifest.build[-1]["calibration"] == samples.record()
    assert samples.record()["samples"] == len(used) == 24


def test_the_record_holds_no_path_and_no_time(int8_bundle, policy_template):
    told = (int8_bundle.path / "manifest.json").read_text()
    assert str(policy_template.parent) not in told
    assert str(int8_bundle.path.parent) not in told
    assert '"/' not in json.dumps(int8_bundle.manifest.build)


def test_the_hash_of_samples_follows_values_types_names_and_order():
    first, second = {"a": np.zeros(2), "text": "go"}, {"a": np.ones(2), "text": "go"}
    variants: list[list[dict[str, Any]]] = [
        [first, second],
        [second, first],
        [first],
        [],
        [{**first, "text": "stop"}, second],
        [{"a": np.zeros(2, np.float32), "text": "go"}, second],
        [{"a": np.zeros((2, 1)), "text": "go"}, second],
        [{"b": np.zeros(2), "text": "go"}, second],
    ]
    hashes = set()
    for variant in variants:
        samples = SampleSet()
        assert list(samples.watch(variant)) == variant
        hashes.add(samples.record()["sha256"])
    assert len(hashes) == len(variants)
    same = SampleSet()
    list(same.watch([{"text": np.array("go"), "a": np.zeros(2)}, second]))
    assert same.record()["sha256"] in hashes


def test_two_input_files_of_one_name_are_both_recorded(policy_dir):
    (policy_dir / "sub").mkdir()
    shutil.copyfile(policy_dir / "evaluation.npz", policy_dir / "sub/calibration.npz")
    description = policy_dir / "policy.yaml"
    description.write_text(description.read_text() + "evaluation: sub/calibration.npz\n")
    files = input_hashes(TorchModule(policy=policy_dir))
    assert files["calibration.npz"] == hash_file(policy_dir / "calibration.npz")
    assert files["calibration.npz (2)"] == hash_file(policy_dir / "evaluation.npz")


# ---- made again


def test_a_torch_policy_is_made_again_from_another_directory(int8_bundle, policy_dir, again):
    made = again(int8_bundle, policy_dir)
    assert made.identical, made.first_difference
    assert made.hash == int8_bundle.hash
    assert made.stages == (("sources.torch_module", True), ("export.onnx", True), ("quantize.static_int8", True))
    assert {item.file for item in made.files} == {*int8_bundle.manifest.files, "manifest.json"}
    assert made.left_out == ()


def test_what_was_made_again_is_written_whole(dynamic_bundle, onnx_policy, again, tmp_path):
    made = again(dynamic_bundle, onnx_policy / "tiny.onnx", out=tmp_path / "out")
    assert made.identical
    assert Bundle.open(tmp_path / "out").hash == dynamic_bundle.hash


def test_no_output_of_a_stage_is_taken_from_the_cache(dynamic_bundle, onnx_policy, again, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    source = OnnxFile(model=onnx_policy / "tiny.onnx", policy=onnx_policy)
    cached = cached_transform(source, None, cache, QUIET).bundle
    before = {path: path.stat().st_mtime_ns for path in cache.rglob("*")}
    (cached.path / GRAPH).write_bytes(b"poison")
    assert again(dynamic_bundle, onnx_policy / "tiny.onnx", cache=cache).identical
    assert set(cache.rglob("*")) == set(before)


def test_an_earlier_bundle_may_be_the_source(int8_bundle, float_bundle, dynamic_bundle, again):
    made = again(int8_bundle, float_bundle.path)
    assert made.identical
    assert made.stages == (("quantize.static_int8", True),)
    with pytest.raises(BundleError, match=r"from which no stage of .* started; recorded: export.onnx from sha256:"):
        again(int8_bundle, dynamic_bundle.path)


def test_a_calibration_file_is_found_by_name_and_hash(float_bundle, policy_dir, again, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    data = Path(shutil.copyfile(policy_dir / "evaluation.npz", elsewhere / "mine.npz"))
    bundle = run_transform(
        StaticInt8(calibration=data, samples=8), float_bundle, elsewhere / "in" / "bundle", QUIET
    ).bundle
    told = f"mine.npz sha256:{hash_file(data)[:16]}"
    assert bundle.manifest.build[-1]["options"] == {"samples": 8, "calibration": told}
    assert bundle.manifest.build[-1]["files"] == {"mine.npz": hash_file(data)}
    with pytest.raises(SourceError, match=r"given the file mine.npz with sha256:.* not here") as caught:
        again(bundle, float_bundle.path)
    assert "--file" in caught.value.fix
    wrong = Path(shutil.copyfile(policy_dir / "calibration.npz", tmp_path / "mine.npz"))
    with pytest.raises(SourceError, match=r"not here \(.*mine.npz has sha256:"):
        again(bundle, float_bundle.path, files=(wrong,))
    renamed = data.rename(elsewhere / "renamed.npz")
    with pytest.raises(SourceError, match=f"renamed.npz has sha256:{told[-16:]}"):
        again(bundle, float_bundle.path, files=(renamed,))
    assert again(bundle, float_bundle.path, files=(renamed.rename(data),)).identical


# ---- the source


def test_a_changed_added_or_missing_file_of_the_source_is_named(int8_bundle, policy_dir, again):
    (policy_dir / "policy.py").write_text((policy_dir / "policy.py").read_text() + "# changed\n")
    (policy_dir / "weights.safetensors").rename(policy_dir / "other.safetensors")
    with pytest.raises(SourceError) as caught:
        again(int8_bundle, policy_dir)
    recorded = int8_bundle.manifest.build[0]["files"]
    message = caught.value.message
    got = hash_file(policy_dir / "policy.py")
    assert f"policy.py: got sha256:{got[:16]}, recorded sha256:{recorded['policy.py'][:16]}" in message
    assert f"weights.safetensors: got no such file, recorded sha256:{recorded['weights.safetensors'][:16]}" in message
    assert "other.safetensors: got sha256:" in message
    assert "recorded no such file" in message


def test_an_unrelated_new_file_beside_the_policy_changes_nothing(float_bundle, policy_dir, again):
    (policy_dir / "experiment.py").write_text("raise SystemExit('never imported')\n")
    assert again(float_bundle, policy_dir).identical


def test_a_changed_helper_that_the_policy_imports_is_named(policy_dir, again, tmp_path):
    (policy_dir / "helper.py").write_text("SCALE = 1.0\n")
    code = (policy_dir / "policy.py").read_text()
    (policy_dir / "policy.py").write_text(f"import helper\n{code}")
    source = cached_transform(source_stage(str(policy_dir)), None, tmp_path / "cache", Context()).bundle
    made = cached_transform(ExportOnnx(), source, tmp_path / "cache", Context()).bundle
    assert again(made, policy_dir).identical
    (policy_dir / "helper.py").write_text("SCALE = 2.0\n")
    with pytest.raises(SourceError, match=r"helper.py: got sha256:.*, recorded sha256:"):
        again(made, policy_dir)


def test_another_kind_of_source_and_another_factory_are_refused(int8_bundle, policy_dir, onnx_policy, again):
    with pytest.raises(SourceError, match=r"is read by sources.onnx; .* was made by sources.torch_module"):
        again(int8_bundle, onnx_policy / "tiny.onnx")
    with pytest.raises(SourceError, match=r"names the factory policy.py:other; .* policy.py:make"):
        again(int8_bundle, f"{policy_dir}/policy.py:other")


def test_the_source_is_found_where_it_was(policy_dir, float_bundle, again, tmp_path, monkeypatch):
    cache = tmp_path / "cache"
    source = cached_transform(TorchModule(policy=policy_dir), None, cache, QUIET).bundle
    assert again(source, cache=tmp_path / "none").identical
    with pytest.raises(SourceError, match=r"does not say where its source is \(a policy named 'tiny'\)"):
        again(float_bundle, cache=tmp_path / "none")
    (policy_dir / "policy.py").write_text("changed")
    with pytest.raises(SourceError, match=r"policy.py: got sha256"):
        again(float_bundle, cache=cache)
    shutil.rmtree(policy_dir)
    with pytest.raises(SourceError, match="or it is gone"):
        again(float_bundle, cache=cache)


def test_the_command_of_the_report_names_no_source(dynamic_bundle, onnx_policy, again, copied):
    bundle = copied(dynamic_bundle)
    (bundle.path / "reports").mkdir(exist_ok=True)
    command = f"vlatool optimize --profile {onnx_policy}/policy.py {onnx_policy}/tiny.onnx -o {bundle.path}"
    report = Report("optimize", "tiny", "pass", command=command)
    (bundle.path / "reports/report.json").write_text(report.to_json())
    with pytest.raises(SourceError, match="does not say where its source is"):
        again(bundle)
    assert again(bundle, f"{onnx_policy}/tiny.onnx").source == f"{onnx_policy}/tiny.onnx"
    (bundle.path / "reports/report.json").write_text("{")
    with pytest.raises(SourceError, match="does not say where its source is"):
        again(bundle)


# ---- records that cannot be used


def test_a_bundle_without_a_record_says_so(int8_bundle, again, copied):
    bundle = copied(int8_bundle)
    old = seal(bundle.path, replace(bundle.manifest, build=()))
    with pytest.raises(BundleError, match=f"no build record; vlatool {__version__} did not write one yet"):
        again(old)
    partly = seal(bundle.path, replace(bundle.manifest, build=bundle.manifest.build[2:]))
    with pytest.raises(BundleError, match=r"begins with quantize.static_int8, whose input \(sha256:"):
        again(partly)


@pytest.mark.parametrize(
    ("number", "change", "says"),
    [
        (2, {"options": ["samples"]}, "Entry 2 of the build record .* is invalid"),
        (1, {"stage": 3}, "Entry 1 of the build record .* is invalid"),
        (2, {"input": 7}, "Entry 2 of the build record .* is invalid"),
        (1, {"stage": "sources.torch_module"}, "Entry 1 .* is a source; only the first may be"),
        (2, {"stage": "quantize.static_in8"}, "did you mean 'quantize.static_int8'"),
        (2, {"stage": "benchmark.latency"}, "benchmark.latency, which measures"),
        (2, {"options": {"calibration": "/etc/passwd"}}, "names the file '/etc/passwd' .* without its hash"),
        (2, {"options": {"samples": 0}}, "samples = 0"),
    ],
)
def test_a_malformed_record_is_the_bundles_fault(int8_bundle, policy_template, again, copied, number, change, says):
    bundle = copied(int8_bundle)
    build = list(bundle.manifest.build)
    build[number] = {**build[number], **change}
    with pytest.raises(VlatoolError, match=says) as caught:
        again(replace(bundle, manifest=replace(bundle.manifest, build=tuple(build))), policy_template)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("build", ["all", ["export.onnx"], [{"options": {}}], {"stage": "x"}])
def test_a_manifest_with_a_malformed_record_is_refused(int8_bundle, copied, build):
    bundle = copied(int8_bundle)
    file = bundle.path / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "build": build}))
    (bundle.path / DIGEST).write_bytes(digest_of(file.read_bytes()))
    with pytest.raises(BundleError, match=r"malformed 'build'|'build' must be a list"):
        Bundle.open(bundle.path)


def test_versions_that_are_not_the_recorded_ones_are_named(int8_bundle):
    entries = build_record(int8_bundle)
    assert version_changes(entries) == {}
    old = {**entries[-1], "vlatool": "0.0.1", "versions": {"numpy": "1.0", "no-such-distribution": "2.0"}}
    assert version_changes((*entries[:-1], old)) == {
        "vlatool": ("0.0.1", __version__),
        "numpy": ("1.0", np.__version__),
        "no-such-distribution": ("2.0", "not installed"),
    }


# ---- what differs


def test_a_changed_weight_is_named(dynamic_bundle, onnx_policy, again, copied):
    import onnx

    bundle = copied(dynamic_bundle)
    model = onnx.load(str(bundle.path / GRAPH))
    changed = next(tensor for tensor in model.graph.initializer if len(tensor.raw_data) > 8)
    changed.raw_data = bytes([changed.raw_data[0] ^ 1]) + changed.raw_data[1:]
    onnx.save(model, str(bundle.path / GRAPH))
    made = again(seal(bundle.path, bundle.manifest), onnx_policy / "tiny.onnx")
    assert not made.identical
    assert [item.file for item in made.files if not item.identical] == [GRAPH, "manifest.json"]
    first = made.first_difference
    assert first is not None
    assert first.why == f"initializers with another content: {changed.name}"
    assert f"files.{GRAPH}.sha256: " in made.files[-1].why
    assert dict(made.stages)["quantize.dynamic_int8"], "the record itself was not changed"


def test_files_of_one_side_and_fields_of_the_manifest_are_named(dynamic_bundle, copied):
    bundle = copied(dynamic_bundle)
    (bundle.path / "assets/statistics.json").unlink()
    (bundle.path / "assets/new.json").write_text("{}")
    other = seal(bundle.path, replace(bundle.manifest, description="changed", accuracy={"success": {"value": 1}}))
    found = {item.file: item for item in compare_bundles(dynamic_bundle, other)}
    assert found["assets/statistics.json"].why == "not in the rebuilt bundle"
    assert found["assets/new.json"].why == "only in the rebuilt bundle"
    assert "description: " in found["manifest.json"].why
    assert list(found)[-1] == "manifest.json"
    accuracy = replace(dynamic_bundle.manifest, accuracy={"success": {"value": 1}})
    (bundle.path / "assets/new.json").unlink()
    shutil.copyfile(dynamic_bundle.path / "assets/statistics.json", bundle.path / "assets/statistics.json")
    other = seal(bundle.path, accuracy)
    assert not all(item.identical for item in compare_bundles(dynamic_bundle, other))
    assert all(item.identical for item in compare_bundles(dynamic_bundle, other, ["accuracy"]))


def test_arrays_that_differ_are_named_with_the_largest_difference(tmp_path):
    one, two = tmp_path / "one.npz", tmp_path / "two.npz"
    save_npz(one, {"a": np.zeros(2), "b": np.zeros(2), "text": np.array(["x"]), "c": np.zeros(1)})
    save_npz(two, {"a": np.array([0, 0.5]), "b": np.zeros(3), "text": np.array(["y"]), "d": np.zeros(1)})
    assert explain(one, two) == (
        "array a (largest difference 0.5), array b float64[2] recorded, float64[3] rebuilt, array c only recorded, "
        "array d only rebuilt, array text"
    )
    two.write_bytes(b"no archive")
    assert explain(one, two).startswith("first difference at byte 0 (")


def test_other_files_are_told_by_their_first_differing_byte(tmp_path):
    one, two = tmp_path / "a.json", tmp_path / "b.json"
    one.write_bytes(b"abcdef")
    two.write_bytes(b"abcxef")
    assert explain(one, two) == "first difference at byte 3 (6 bytes recorded, 6 rebuilt)"
    two.write_bytes(b"abc")
    assert explain(one, two) == "first difference at byte 3 (6 bytes recorded, 3 rebuilt)"


def test_graphs_that_differ_in_nodes_and_notes_are_told_apart(float_bundle, tmp_path):
    import onnx

    one, two = float_bundle.path / GRAPH, tmp_path / "two.onnx"
    model = onnx.load(str(one))
    model.producer_version = "another"
    model.graph.node[0].name = "renamed"
    onnx.save(model, str(two))
    said = explain(one, two)
    assert "nodes only rebuilt: renamed" in said
    assert 'producer_version: "' in said
    assert "initializer" not in said
    model = onnx.load(str(one))
    model.graph.initializer.append(model.graph.initializer[0])
    del model.graph.initializer[0]
    onnx.save(model, str(two))
    assert explain(one, two) == "the initializers are in another order"
    two.write_bytes(b"\xff\xff")
    assert explain(one, two).startswith("first difference at byte 0")


def test_a_long_list_is_cut():
    assert name_list(["a", "b"]) == "a, b"
    assert name_list(list("abcdefg")) == "a, b, c, d, e and 2 more"


# ---- determinism


def test_the_same_command_in_another_process_gives_the_same_bytes(policy_template, tmp_path):
    """Another hash seed, other thread counts, other processors, another directory: every byte is the same."""
    processes = []
    cores = sorted(os.sched_getaffinity(0))
    for number, (seed, threads) in enumerate((("1", "1"), ("20", "4"))):
        place = tmp_path / f"place{number}"
        shutil.copytree(policy_template, place / "tiny")
        environment = {"PYTHONHASHSEED": seed, "OMP_NUM_THREADS": threads, "VLATOOL_CACHE": str(place / "cache")}
        allowed = cores if number else cores[:1]
        code = f"import os, sys; os.sched_setaffinity(0, {allowed}); from vlatool.cli import main; main(sys.argv[1:])"
        command = [sys.executable, "-c", code, "quantize", "static-int8", "tiny", "-o", "out"]
        settings: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        processes.append(subprocess.Popen(command, cwd=place, env={**os.environ, **environment}, **settings))
    for process in processes:
        assert process.wait() == 0, process.communicate()
        process.communicate()
    one, two = (Bundle.open(tmp_path / name / "out") for name in ("place0", "place1"))
    assert one.hash == two.hash
    exports = [next((tmp_path / name / "cache/stages").glob("export.onnx-*")) for name in ("place0", "place1")]
    pairs = [(one.path, two.path), (exports[0], exports[1])]
    for left, right in pairs:
        names = {path.relative_to(left) for path in left.rglob("*") if path.is_file()}
        assert names == {path.relative_to(right) for path in right.rglob("*") if path.is_file()}
        assert [name for name in names if (left / name).read_bytes() != (right / name).read_bytes()] == []


@pytest.mark.parametrize(
    ("differing", "first"),
    [
        (("golden/golden.npz", GRAPH, "manifest.json"), GRAPH),
        ((GRAPH, "data/calibration.npz"), "data/calibration.npz"),
        (("golden/golden.npz", "assets/statistics.json"), "assets/statistics.json"),
        (("manifest.json", "golden/golden.npz"), "golden/golden.npz"),
        (("manifest.json",), "manifest.json"),
        (("graphs/main.onnx", "module/edits.json", "recipe.yaml"), "module/edits.json"),
    ],
)
def test_the_file_that_others_were_made_from_is_the_first_difference(differing, first):
    files = tuple(FileMatch(name, 1, False, "other") for name in sorted(differing))
    found = RebuildResult(Bundle(Path("b"), None), "", "", files, ()).first_difference  # type: ignore[arg-type]
    assert found is not None
    assert found.file == first
