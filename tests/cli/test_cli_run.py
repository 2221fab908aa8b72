"""``vlatool run --dry-run``: the layers between a bundle and a robot, with their times."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from _two_systems import two_systems

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec

JOINTS = tuple(f"joint{number}" for number in range(1, 8))


WEIGHTS = ", ".join(["0.01"] * 14)
PRODUCT = f"g (float[1,7] q) => (float[1,2] y) <float[7,2] w = {{{WEIGHTS}}}> {{ y = MatMul(q, w) }}"


def written(folder: Path, text: str, action: TensorSpec, hz: float = 50.0) -> Bundle:
    """Seal a bundle of one graph from q (1, 7) to y."""
    import onnx
    import onnx.parser

    (folder / "graphs").mkdir(parents=True)
    onnx.save(onnx.parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}'), folder / "graphs/main.onnx")
    spec = PolicySpec((TensorSpec("q", (1, 7), labels=JOINTS),), (action,), hz)
    sealed = seal(folder, Manifest("held", "1", spec, program=single_graph(spec)))
    return seal(folder, Manifest(**{**vars(sealed.manifest), "graphs": {"main": Graph("graphs/main.onnx", opset=20)}}))


@pytest.fixture
def speeds(tmp_path: Path) -> Bundle:
    action = TensorSpec("y", (1, 2), labels=("forward", "turn"), mode="velocity")
    return written(tmp_path / "speeds", PRODUCT, action, 100.0)


def test_it_shows_the_layers_and_what_is_left_of_the_control_period(vlatool, speeds: Bundle) -> None:
    code, out, err = vlatool("run", speeds.path, "--dry-run", "--steps", 20, "--threads", 1)
    assert (code, err) == (0, "")
    for word in ("FallbackLadder", "ChunkQueue", "Deadline", "BundlePolicy", "control period 10 ms, deadline 10 ms",
                 "inference  p50", "act        p50", "0  policy", "1  chunk", "2  decelerate", "3  stop"):  # fmt: skip
        assert word in out
    assert out.index("FallbackLadder") < out.index("Deadline")
    assert "main  CPUExecutionProvider: 1 nodes, float32 100.0%" in out


def test_of_two_systems_the_fast_part_has_to_be_in_time_and_both_are_shown(vlatool) -> None:
    code, out, err = vlatool("run", two_systems().path, "--dry-run", "--steps", 20, "--threads", 1, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert [note["layer"] for note in found["layers"]][-2:] == ["DualRate", "BundlePolicy"]
    assert found["slow"]["samples"] == 20
    assert found["cadence"]["latent"]["part"] == "latent age"
    out = vlatool("run", two_systems().path, "--dry-run", "--steps", 20, "--threads", 1)[1]
    assert "slow part  p50" in out
    assert "latent age" in out


def test_a_robot_and_a_second_bundle_add_theirs(vlatool, speeds: Bundle) -> None:
    code, out, err = vlatool("run", speeds.path, "--dry-run", "--steps", 20, "--threads", 1, "--robot", "turtlebot-4",
                             "--deadline-ms", 8, "--fallback", speeds.path, "--json")  # fmt: skip
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert [note["layer"] for note in found["layers"]][:2] == ["EnvelopeController", "FallbackLadder"]
    assert [rung["source"] for rung in found["rungs"]] == ["policy", "chunk", "fallback", "decelerate", "stop"]
    assert [rung["time"] is None for rung in found["rungs"]] == [False, True, False, True, True]
    assert found["engine"]["graphs"][0]["shares"] == [
        {"provider": "CPUExecutionProvider", "nodes": 1, "macs": {"float32": 1.0}}
    ]
    assert (found["period_ms"], found["deadline_ms"], found["answer"]["samples"]) == (10, 8, 20)


def test_a_faster_control_loop_is_played_at_its_own_rate(vlatool, speeds: Bundle) -> None:
    code, out, err = vlatool("run", speeds.path, "--dry-run", "--steps", 20, "--threads", 1, "--json",
                             "--controller", "interpolation:factor=4")  # fmt: skip
    assert (code, err) == (0, "")
    assert (json.loads(out)["period_ms"], json.loads(out)["deadline_ms"]) == (2.5, 2.5)


def test_a_label_without_motion_is_refused_for_a_velocity(vlatool, speeds: Bundle) -> None:
    code, _, err = vlatool("run", speeds.path, "--dry-run", "--neutral", "stop")
    assert code == 2
    assert "neutral is 'stop', and the action 'y' is not discrete" in err


def test_a_policy_that_is_too_slow_for_its_deadline_ends_with_1(vlatool, speeds: Bundle) -> None:
    code, _, err = vlatool("run", speeds.path, "--dry-run", "--steps", 20, "--deadline-ms", 0.0001)
    assert code == 1
    assert "the fallback would act most of the time" in err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [((), 2, "does not say which topics its inputs and actions are"),
     (("--dry-run", "--deadline-ms", 11), 2, "longer than the control"),
     (("--dry-run", "--robot", "no-robot"), 3, "no-robot"), (("--dry-run", "--robot", "ur5e"), 2, "has 2 elements"),
     (("--dry-run", "--deadline-ms", 0), 2, "deadline_ms is 0"),
     (("--dry-run", "--controller", "nobody"), 2, "nobody"), (("--dry-run", "--fallback", "nothing"), 3, "nothing")],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(vlatool, speeds: Bundle, words: tuple[object, ...], code: int, message: str):
    status, _, err = vlatool("run", speeds.path, *words)
    assert (status, message in err) == (code, True), err


def test_a_discrete_action_needs_a_label_without_motion(vlatool, tmp_path: Path) -> None:
    action = TensorSpec("y", (1, 2), kind="discrete", labels=("on", "off"))
    path = written(tmp_path / "buttons", PRODUCT, action, 100.0).path
    code, _, err = vlatool("run", path, "--dry-run", "--steps", 20)
    assert code == 2
    assert "known to mean no motion" in err
    code, out, _ = vlatool("run", path, "--dry-run", "--steps", 20, "--neutral", "off")
    assert code == 0
    assert "hold" in out
