"""``export`` and ``quantize`` for a board: made as it takes it, and what to expect there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.cli._board_summary import BoardSummary, board_summary
from vlatool.errors import GraphError
from vlatool.hardware.profile import load_profile
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.stage.base import Context


def run(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> str:
    with pytest.raises(SystemExit) as left:
        main([*words])
    told = capsys.readouterr()
    assert left.value.code == code, told.err
    return told.out if code == 0 else told.err


def test_the_layout_and_the_activations_follow_the_board() -> None:
    orin, pi, nuc = (load_profile(name) for name in ("orin-nano", "pi5", "nuc"))
    assert (StaticInt8().on(orin).layout, StaticInt8().on(orin).activations) == ("qdq", "int8")
    for board in (pi, nuc):
        assert (StaticInt8().on(board).layout, StaticInt8().on(board).activations) == ("ort", "auto")
    assert (WeightOnly().on(orin).layout, WeightOnly().on(pi).layout) == ("qdq", "ort")
    assert DynamicInt8().on(orin) == DynamicInt8()


def test_openvino_takes_a_layout_of_its_own() -> None:
    nuc = load_profile("nuc")
    first = nuc.model_copy(update={"engines": {"openvino": nuc.engines["openvino"], **nuc.engines}})
    assert first.engine == "openvino"
    assert (StaticInt8().on(first).layout, StaticInt8().on(first).activations) == ("openvino", "auto")


def test_what_was_typed_stays_as_typed() -> None:
    typed = StaticInt8(layout="ort", activations="uint8").on(load_profile("orin-nano"))
    assert (typed.layout, typed.activations) == ("ort", "uint8")
    assert WeightOnly(layout="ort").on(load_profile("thor")).layout == "ort"


def test_a_bundle_for_a_board_ends_with_what_to_expect(float_bundle: Bundle, tmp_path: Path, capsys) -> None:
    told = run(capsys, "quantize", str(float_bundle.path), "-o", str(tmp_path / "out"), "--profile", "orin-nano")
    lines = [line.strip() for line in told.splitlines()]
    assert any(line.startswith("graphs ") and " -> " in line and "smaller" in line for line in lines), told
    assert any(line.startswith("latency p50 on jetson-orin-nano, predicted: ") and " ms (" in line for line in lines)
    (memory,) = (line for line in lines if line.startswith("memory on jetson-orin-nano, predicted: "))
    assert "e+" not in memory
    assert any(line.startswith("relative error of the actions: 0.0") for line in lines)
    assert json.loads((tmp_path / "out/manifest.json").read_text())["made_by"]["options"]["layout"] == "qdq"


def test_as_json(float_bundle: Bundle, tmp_path: Path, capsys) -> None:
    words = ["quantize", str(float_bundle.path), "-o", str(tmp_path / "out"), "--json"]
    found = json.loads(run(capsys, *words, "--profile", "pi5"))["board"]
    assert found["board"] == "raspberry-pi-5"
    assert found["graphs_before"] > found["graphs_after"] > 0
    latency = found["predictions"]["latency_p50"]
    assert latency["low"] < latency["value"] < latency["high"]
    assert (found["actions"]["name"], 0 < found["actions"]["value"] < 0.1) == ("relative_error", True)
    assert json.loads(run(capsys, *words, "--force"))["board"] is None


def test_an_export_says_it_too_and_an_unknown_board_is_refused(onnx_file: Path, tmp_path: Path, capsys) -> None:
    told = run(capsys, "export", str(onnx_file), "-o", str(tmp_path / "out"), "--profile", "rpi5")
    assert "latency p50 on raspberry-pi-5, predicted: " in told
    assert "smaller" not in told
    told = run(capsys, "export", str(onnx_file), "-o", str(tmp_path / "no"), "--profile", "jetson-agx-orinn", code=3)
    assert "did you mean 'jetson-agx-orin-64gb'" in told
    assert not (tmp_path / "no").exists()


def test_without_recordings_or_a_source_nothing_is_compared(float_bundle: Bundle, onnx_file: Path) -> None:
    assert board_summary(float_bundle, None, load_profile("pi5"), Context()).error is None


def test_a_policy_that_is_not_exported_yet_is_not_predicted(policy_dir: Path, tmp_path: Path, capsys) -> None:
    told = run(capsys, "prune", "magnitude", str(policy_dir), "-o", str(tmp_path / "out"), "--profile", "pi5")
    assert "predicted for raspberry-pi-5 once it is exported: vlatool export --profile raspberry-pi-5" in told
    assert "graphs " not in told


def test_what_cannot_be_predicted_is_said_when_the_bundle_is_written(
    float_bundle: Bundle, tmp_path: Path, capsys, monkeypatch
) -> None:
    def fails(profile: object, made: object) -> None:
        raise GraphError("The graph cannot be counted.")

    monkeypatch.setattr("vlatool.latency_model.predict.predictions", fails)
    words = ["quantize", "dynamic-int8", str(float_bundle.path), "-o", str(tmp_path / "out"), "--profile", "pi5"]
    told = run(capsys, *words)
    assert "nothing is predicted for raspberry-pi-5: The graph cannot be counted." in told
    assert (tmp_path / "out/manifest.json").is_file()


def test_a_bundle_of_equal_size_is_not_smaller() -> None:
    assert BoardSummary("pi5", 1000, 1000, (), None).lines() == ["graphs 0.00 MB -> 0.00 MB"]
    assert BoardSummary("pi5", 3_000_000, 1_000_000, (), None).lines() == ["graphs 3.00 MB -> 1.00 MB, 3.0x smaller"]
