"""Finite differences of policies whose derivatives are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.cli import main
from vlatool.errors import BundleError
from vlatool.runtime.identity import policy_identity
from vlatool.verify.influence import sensitivity

MATRIX = np.array([[2.0, 0.0], [-0.5, 0.0], [0.0, 30.0]], np.float32)


def linear(folder: Path, *, squared: bool = False) -> Bundle:
    """A policy whose action is its state times a matrix, or the square of that."""
    nodes = [helper.make_node("MatMul", ["state", "w"], ["product"])]
    nodes += [helper.make_node("Mul", ["product", "product" if squared else "one"], ["action"])]
    weights = [onnx.numpy_helper.from_array(MATRIX, "w"), onnx.numpy_helper.from_array(np.float32([1]), "one")]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width]) for name, width in
            (("state", 3), ("action", 2))]  # fmt: skip
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), folder / "main.onnx")
    state = TensorSpec("state", (1, 3), unit=("m", "m", "rad"), labels=("x", "y", "turn"))
    spec = PolicySpec((state,), (TensorSpec("action", (1, 2), unit=("m", "deg"), labels=("forward", "spin")),), 10)
    files = {"main.onnx": FileRecord("0" * 64, 0)}
    return seal(folder, Manifest("linear", "1", spec, {"main": Graph("main.onnx")}, single_graph(spec), files))


def by_ends(found: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    return {(each["input"], each["output"]): each for each in found["influences"]}


def test_slopes_are_those_of_a_linear_policy_with_sign_and_unit(tmp_path):
    bundle = linear(tmp_path)
    found = sensitivity(bundle, 6)
    moved = by_ends(found)
    for row, name in enumerate(("x", "y", "turn")):
        for column, output in enumerate(("forward", "spin")):
            assert moved[f"state.{name}", output]["slope"] == pytest.approx(MATRIX[row, column], rel=1e-3, abs=1e-4)
    assert moved["state.turn", "spin"]["unit"] == "deg/rad"
    assert moved["state.y", "forward"]["effect"] < 0
    assert moved["state.x", "forward"]["agreement"] == 1
    assert (found["identity"], found["recorded"], found["left_out"]) == (policy_identity(bundle), False, [])


def test_a_sign_that_changes_is_said(tmp_path):
    moved = by_ends(sensitivity(linear(tmp_path, squared=True), 16))
    assert 0.3 < moved["state.turn", "spin"]["agreement"] < 1


def test_the_largest_effect_comes_first_and_images_move_by_colour(float_bundle):
    found = sensitivity(float_bundle, 4)
    effects = [abs(each["effect"]) for each in found["influences"]]
    assert effects == sorted(effects, reverse=True)
    names = {each["input"] for each in found["influences"]}
    assert names == {"proprio.0", "proprio.1", "proprio.2", "image.red", "image.green", "image.blue"}
    assert (found["samples"], found["recorded"], found["left_out"]) == (4, True, ["instruction"])
    assert by_ends(found)["image.red", "dx"]["unit"] == "m/level"


def test_a_bundle_without_graphs_is_refused(source_bundle):
    with pytest.raises(BundleError, match="no graph to run"):
        sensitivity(source_bundle, 4)


@pytest.mark.parametrize("as_json", [False, True])
def test_inspect_shows_it(float_bundle, capfd, as_json):
    with pytest.raises(SystemExit, match="0"):
        main(["inspect", str(float_bundle.path), "--sensitivity", "--samples", "3", *(["--json"] if as_json else [])])
    out = capfd.readouterr().out
    if as_json:
        assert json.loads(out) == sensitivity(float_bundle, 3)
    else:
        assert "moves      on 3 recorded observations" in out
        assert "proprio.2 -> dy" in out
        assert "not moved: instruction" in out
