"""``vlatool rebuild`` as a person types it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from vlatool.bundle.bundle import Bundle, seal
from vlatool.cli import main

SMOOTH = "candidates: {smooth: [quantize.smooth_quant: {}]}\neffort: {episodes: 0, iterations: 20}\n"
RECIPE = """\
candidates:
  small:
  - quantize.dynamic_int8: {per_channel: false}
limits: {max_drop: 1.0}
effort: {episodes: 0, iterations: 20}
"""


@pytest.fixture
def source(policy_dir: Path, onnx_file: Path) -> Path:
    """An ONNX file with a description beside it."""
    return Path(shutil.move(onnx_file, policy_dir / "tiny.onnx"))


@pytest.fixture(scope="module")
def quantized_once(policy_template: Path, float_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``vlatool quantize dynamic-int8`` makes of such a file, elsewhere; read only."""
    place = tmp_path_factory.mktemp("quantized")
    folder = shutil.copytree(policy_template, place / "tiny")
    file = shutil.copyfile(float_bundle.path / "graphs/main.onnx", folder / "tiny.onnx")
    with pytest.raises(SystemExit) as left:
        main(["quantize", "dynamic-int8", str(file), "-o", str(place / "bundle")])
    assert not left.value.code
    return place / "bundle"


@pytest.fixture
def quantized(quantized_once: Path, tmp_path: Path) -> Bundle:
    """A copy of it."""
    return Bundle.open(Path(shutil.copytree(quantized_once, tmp_path / "bundle")))


def test_an_identical_bundle_passes(vlatool, quantized, source, tmp_path):
    code, out, err = vlatool("rebuild", quantized.path, "--source", source, "--check", "-o", tmp_path / "again")
    assert code == 0, err
    lines = [line for line in out.splitlines() if not line.startswith("left out")]
    assert lines[:3] == [
        f"source    {source}",
        "stages    sources.onnx -> quantize.dynamic_int8",
        "versions  as recorded",
    ]
    assert lines[4].split() == ["file", "bytes", "identical"]
    table = {line.split()[0]: line.split()[1:] for line in lines[5 : 5 + len(quantized.manifest.files) + 1]}
    assert set(table) == {*quantized.manifest.files, "manifest.json"}
    size = quantized.manifest.files["graphs/main.onnx"].bytes
    assert table["graphs/main.onnx"] == [str(size), "yes"]
    assert lines[-2].startswith(f"identical: {len(table)} files, ")
    assert lines[-2].endswith(quantized.hash)
    assert lines[-1] == f"bundle: {tmp_path / 'again'}"
    assert Bundle.open(tmp_path / "again").hash == quantized.hash


def test_a_difference_fails_the_check_alone(vlatool, quantized, source, tmp_path):
    seal(quantized.path, replace(quantized.manifest, description="another"))
    code, out, err = vlatool("rebuild", quantized.path, "--source", source, "--check")
    assert code == 1
    assert 'manifest.json: description: "another" recorded, ' in out
    assert "differs: 1 of " in out
    assert "error: manifest.json differs: description: " in err
    assert "fix: the versions are the recorded ones, and so are the graphs; " in err
    assert "the bundle was changed after it was made" in err
    line = ["rebuild", quantized.path, "--source", source, "-o", tmp_path / "again"]
    assert vlatool(*line)[0] == 0
    assert vlatool(*line)[0] == 3
    assert vlatool(*line, "--force")[0] == 0


def test_a_graph_is_told_by_its_initializers_and_the_stage_since_which_it_differs(vlatool, quantized, source):
    import onnx

    graph = quantized.path / "graphs/main.onnx"
    model = onnx.load(str(graph))
    weight = next(tensor for tensor in model.graph.initializer if len(tensor.raw_data) > 8)
    weight.raw_data = bytes([weight.raw_data[0] ^ 1]) + weight.raw_data[1:]
    onnx.save(model, str(graph))
    build = quantized.manifest.build
    changed = ({**build[0], "graphs": {"graphs/main.onnx": "00"}}, *build[1:])
    seal(quantized.path, replace(quantized.manifest, build=changed))
    code, _, err = vlatool("rebuild", quantized.path, "--source", source, "--check")
    assert code == 1
    assert f"error: graphs/main.onnx differs: initializers with another content: {weight.name}." in err
    assert "The graphs differ since sources.onnx." in err
    assert "the kind of processor" in err


def test_what_was_changed_after_it_was_made_is_told_from_what_a_stage_gives(vlatool, quantized, source, resealed):
    """The record names the graphs that each stage made, and these come again: so the policy's code is not to blame."""
    import onnx

    graph = quantized.path / "graphs/main.onnx"
    model = onnx.load(str(graph))
    model.graph.doc_string = "changed"
    onnx.save(model, str(graph))
    resealed(quantized)
    code, _, err = vlatool("rebuild", quantized.path, "--source", source, "--check")
    assert (code, "graphs/main.onnx differs" in err) == (1, True)
    assert "every stage gave the recorded graphs: the bundle was changed after it was made" in err
    assert "random" not in err


@pytest.mark.filterwarnings("ignore:ranges from 2 calibration samples")
def test_a_graph_that_differs_is_named_before_the_golden_outputs_that_follow_from_it(vlatool, source, tmp_path):
    assert vlatool("quantize", "static-int8", source, "-o", tmp_path / "bundle")[0] == 0
    made = Bundle.open(tmp_path / "bundle")
    fewer = (*made.manifest.build[:-1], {**made.manifest.build[-1], "options": {"samples": 2}})
    seal(made.path, replace(made.manifest, build=fewer))
    code, out, err = vlatool("rebuild", made.path, "--source", source, "--check")
    assert (code, "golden/golden.npz: array" in out) == (1, True)
    assert "error: graphs/main.onnx differs" in err
    assert "The graphs differ since quantize.static_int8." in err


def test_what_is_in_no_hash_is_said_to_be_left_out(vlatool, quantized, source):
    (quantized.path / "reports").mkdir(exist_ok=True)
    (quantized.path / "reports/praise.md").write_text("10 times as fast")
    (quantized.path / "SIGNATURE").write_text("mine")
    code, out, _ = vlatool("rebuild", quantized.path, "--source", source, "--check")
    assert code == 0
    assert "left out  reports, SIGNATURE" in out
    assert "in no hash" in out


def test_other_versions_are_said_first_and_named_as_the_cause(vlatool, quantized, source):
    build = tuple({**entry, "versions": {**entry["versions"], "onnx": "0.9"}} for entry in quantized.manifest.build)
    seal(quantized.path, replace(quantized.manifest, build=build))
    code, out, err = vlatool("rebuild", quantized.path, "--source", source, "--check")
    assert code == 1
    assert out.startswith("versions differ from the recorded ones: onnx 0.9 recorded, ")
    assert "build[0].versions.onnx: " in err
    assert "fix: the likely cause are the versions (onnx 0.9 recorded, " in err


def test_json_says_the_same(vlatool, quantized, source):
    code, out, _ = vlatool("rebuild", quantized.path, "--source", source, "--check", "--json")
    told = json.loads(out)
    assert code == 0
    assert told["identical"]
    assert told["hash"] == {"recorded": quantized.hash, "rebuilt": quantized.hash}
    assert told["versions"] == {}
    assert told["stages"][-1] == {"stage": "quantize.dynamic_int8", "graphs_identical": True}
    assert {item["file"] for item in told["files"]} == {*quantized.manifest.files, "manifest.json"}
    seal(quantized.path, replace(quantized.manifest, version="9.9.9"))
    code, out, err = vlatool("rebuild", quantized.path, "--source", source, "--check", "--json")
    assert code == 1
    told = json.loads(out)
    assert not told["identical"]
    assert told["files"][-1]["why"].startswith("version: ")
    assert "error: manifest.json differs" in err


def test_the_wrong_call_and_the_wrong_source_have_their_own_codes(vlatool, quantized, source, tmp_path):
    code, _, err = vlatool("rebuild", quantized.path)
    assert code == 2
    assert "--check" in err
    code, _, err = vlatool("rebuild", quantized.path, "--check", "--source", tmp_path / "none.onnx")
    assert code == 3
    assert "No such ONNX file" in err
    code, _, err = vlatool("rebuild", quantized.path, "--check")
    assert code == 3
    assert "pass --source SOURCE" in err
    assert vlatool("rebuild", tmp_path / "no_bundle", "--check")[0] == 3
    with (source.parent / "policy.yaml").open("a") as stream:
        stream.write("# changed\n")
    code, _, err = vlatool("rebuild", quantized.path, "--check", "--source", source)
    assert code == 3
    assert "policy.yaml: got sha256:" in err
    assert vlatool("rebuild", "--help")[1].startswith("Usage:")


def test_what_optimize_hands_out_is_made_again(vlatool, source, tmp_path):
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    chosen = tmp_path / "chosen"
    line = ["optimize", source, "--profile", "raspberry-pi-5", "--recipe", tmp_path / "recipe.yaml", "-o", chosen]
    assert vlatool(*line)[0] == 0
    code, out, err = vlatool("rebuild", chosen, "--source", source, "--check")
    assert code == 0, err
    assert " -> optimize" in out
    assert "left out  accuracy in manifest.json: measured, so not the same twice; reports, recipe.yaml" in out
    bundle = Bundle.open(chosen)
    assert bundle.manifest.accuracy
    seal(chosen, replace(bundle.manifest, accuracy={"success": {"value": 0.5, "samples": 3}}))
    assert vlatool("rebuild", chosen, "--source", source, "--check")[0] == 0


def test_what_is_made_of_what_optimize_hands_out_is_made_again(vlatool, source, tmp_path):
    """The only candidate is a float32 one, so that whatever is chosen can be quantized."""
    (tmp_path / "recipe.yaml").write_text(SMOOTH)
    chosen = tmp_path / "chosen"
    line = ["optimize", source, "--profile", "raspberry-pi-5", "--recipe", tmp_path / "recipe.yaml", "-o", chosen]
    assert vlatool(*line, "--max-drop", "100%")[0] == 0
    derived = tmp_path / "derived"
    assert vlatool("quantize", "dynamic-int8", chosen, "-o", derived)[0] == 0
    assert [entry["stage"] for entry in Bundle.open(derived).manifest.build][-2:] == [
        "optimize",
        "quantize.dynamic_int8",
    ]
    code, out, err = vlatool("rebuild", derived, "--source", source, "--check")
    assert code == 0, out + err
    assert vlatool("rebuild", derived, "--source", chosen, "--check")[0] == 0
