"""What a stage found to be wrong is told by every command, and refused until it is overruled by its name."""

from __future__ import annotations

import json

import pytest

from vlatool.bundle.bundle import Bundle

RECIPE = "candidates: {mine: [quantize.dynamic_int8: {}]}\nlimits: {max_drop: 1.0, hz: 1000000}\n"


@pytest.fixture
def wrong(vlatool, wrong_engine, float_bundle, tmp_path):
    """Status, stdout and stderr of a stage that found its engine to be wrong, and where its bundle is."""
    wrong_engine(1.5)
    out = tmp_path / "wrong"
    return (*vlatool("quantize", "dynamic-int8", float_bundle.path, "-o", out, "--json"), out)


def test_the_stage_fails_but_leaves_the_bundle_to_be_looked_at(wrong, float_bundle):
    code, out, err, path = wrong
    assert code == 1
    assert json.loads(out)["findings"][0]["name"] == "engine-difference"
    assert f"error: {path} was written, but it is wrong: the engine ort_cpu computes another action" in err
    assert "to overrule: engine-difference" in err
    assert f"vlatool explain {path} --baseline {float_bundle.path}; load" in err
    assert Bundle.open(path).manifest.findings[0]["value"] == pytest.approx(0.5, abs=1e-3)


def test_inspect_shows_it(wrong, vlatool):
    code, out, _ = vlatool("inspect", wrong[3])
    assert code == 0
    assert "  WRONG      engine-difference: the engine ort_cpu computes another action" in out
    assert json.loads(vlatool("inspect", wrong[3], "--json")[1])["findings"]


def test_explain_begins_with_it(wrong, vlatool, float_bundle):
    _, out, _ = vlatool("explain", wrong[3], "--baseline", float_bundle.path, "--json", "--no-suggest")
    assert "the engine ort_cpu computes another action" in json.loads(out)["summary"][0]


def test_the_gate_refuses_it(wrong, vlatool, float_bundle):
    code, out, err = vlatool("gate", wrong[3], "--baseline", float_bundle.path)
    assert (code, out) == (3, "")
    assert "was found to be wrong when it was made (engine-difference)" in err


def test_the_gate_takes_it_when_it_is_overruled(wrong, vlatool, float_bundle, tmp_path):
    config = tmp_path / "gate.yaml"
    config.write_text("{accept: [engine-difference], latency: null, accuracy: null, memory: null, size: {margin: 9}}")
    code, out, _ = vlatool("gate", wrong[3], "--baseline", float_bundle.path, "--config", config)
    assert code == 0
    assert "size: pass" in out


def test_optimize_does_not_take_such_a_candidate(vlatool, wrong_engine, onnx_file, policy_dir, tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    wrong_engine(1.5)
    line = ["optimize", onnx_file, "--recipe", recipe, "--cache", tmp_path / "cache", "--iterations", 20]
    code, _, err = vlatool(*line, "-o", tmp_path / "out", "--episodes", 0)
    assert code == 3
    assert "found to be wrong when it was made (engine-difference)" in err
    assert not (tmp_path / "out").exists()
    code, _, err = vlatool(*line, "-o", tmp_path / "out", "--episodes", 0, "--accept", "engine-difference")
    assert code == 1, err
    assert (tmp_path / "out/manifest.json").is_file()
