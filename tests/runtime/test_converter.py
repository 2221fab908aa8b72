"""Actions and states that mean another thing to the robot than to the network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _written import written

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.runtime import Policy, load
from vlatool.runtime.converter import action_converter
from vlatool.runtime.observation import EncodedObservation

ECHO = "g (float[1,{width}] s, float[1,{length},{width}] x) => (float[1,{length},{width}] y) {{ y = Add(x, s) }}"
CHUNK = "g (float[1,3] s, float[1,2,3] x) => (float[1,2,3] y, float[1,3] z) { y = Identity(x)  z = Identity(s) }"
NAMES = {"labels": ["one", "two", "grip"]}


def tensor(name: str, *shape: int, **more: Any) -> TensorSpec:
    return TensorSpec.from_dict({"name": name, "shape": list(shape), **more})


def opened(folder: Path, *convert: dict[str, Any], state: dict[str, Any] | None = None, **more: Any) -> Policy:
    """Open a policy whose action is its input ``x``, (1, 2, 3), converted; its other input is the state ``s``."""
    inputs = (tensor("s", 1, 3, **(state or {})), tensor("x", 1, 2, 3))
    outputs = (tensor("y", 1, 2, 3, convert=list(convert), **more), tensor("z", 1, 3))
    return load(written(folder, CHUNK, inputs, outputs, chunk=2).path)


STATE = np.array([10, 20, 30], np.float32)
X = np.arange(6, dtype=np.float32).reshape(2, 3)


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ({}, X + STATE),
        ({"parts": [[0, 2]]}, X + np.array([10, 20, 0])),
        ({"parts": ["one", 1]}, X + np.array([10, 20, 0])),
        ({"parts": "grip"}, X + np.array([0, 0, 30])),
        ({"parts": ["grip"], "state": [0]}, X + np.array([0, 0, 10])),
        ({"parts": [0, 2], "state": [[1, 2], 0]}, X + np.array([20, 0, 10])),
        ({"successive": True}, np.cumsum(X, 0) + STATE),
        ({"successive": True, "parts": [1]}, np.stack([X[0] + [0, 20, 0], X[1] + [0, 21, 0]])),
    ],
)
def test_differences_from_the_state_become_targets(tmp_path: Path, step: dict[str, Any], expected: Any) -> None:
    policy = opened(tmp_path, {"op": "relative", "to": "s", **step}, state=NAMES, **NAMES)
    action = policy.infer({"s": STATE, "x": X})
    np.testing.assert_array_equal(action.chunk, expected)
    np.testing.assert_array_equal(action.outputs["y"], X[None])
    assert action.labels == ("one", "two", "grip")


def test_the_state_is_that_of_each_inference_and_is_not_changed(tmp_path: Path) -> None:
    policy, state = opened(tmp_path, {"op": "relative", "to": "s"}), STATE.copy()
    for number in range(3):
        given = state + number
        np.testing.assert_array_equal(policy.infer({"s": given[None], "x": X}).chunk, X + STATE + number)
        np.testing.assert_array_equal(given, STATE + number)


STATISTICS = {"s": {"mean": [1, 2, 3], "std": [2, 4, 8]}, "y": {"mean": [0, 1, 0], "std": [2, 2, 10]}}
BY_MEAN = {"normalisation": "mean_std", "statistics": "stats.json#"}


def normalised(tmp_path: Path, **action: Any) -> PolicySpec:
    (tmp_path / "stats.json").write_text(__import__("json").dumps(STATISTICS))
    state = tensor("s", 1, 3, normalisation="mean_std", statistics="stats.json#s")
    return PolicySpec((state,), (tensor("y", 1, 2, 3, **action),), 10, chunk=2)


def test_a_state_is_added_in_the_units_of_the_robot(tmp_path: Path) -> None:
    convert = [{"op": "relative", "to": "s"}]
    spec = normalised(tmp_path, normalisation="mean_std", statistics="stats.json#y", convert=convert)
    converter = action_converter(spec, tmp_path)
    np.testing.assert_array_equal(converter.to_robot(X, STATE), X * [2, 2, 10] + [0, 1, 0] + STATE)
    np.testing.assert_allclose(converter.to_network(converter.to_robot(X, STATE), STATE), X, rtol=1e-6)


@pytest.mark.parametrize("successive", [False, True])
def test_a_target_becomes_a_difference_again(tmp_path: Path, successive: bool) -> None:
    spec = normalised(tmp_path, convert=[{"op": "relative", "to": "s", "successive": successive, "parts": [2, 0]}])
    converter = action_converter(spec, tmp_path)
    np.testing.assert_array_equal(converter.to_network(converter.to_robot(X, STATE), STATE), X)


def test_an_encoded_observation_has_its_state(tmp_path: Path) -> None:
    (tmp_path / "b/assets").mkdir(parents=True)
    (tmp_path / "b/assets/stats.json").write_text('{"s": {"mean": [1, 2, 3], "std": [2, 4, 8]}}')
    inputs = (tensor("s", 1, 3, normalisation="mean_std", statistics="stats.json#s"), tensor("x", 1, 2, 3))
    outputs = (tensor("y", 1, 2, 3, convert=[{"op": "relative", "to": "s"}]), tensor("z", 1, 3))
    policy = load(written(tmp_path / "b", CHUNK, inputs, outputs, chunk=2).path)
    encoded = policy.encode({"s": STATE, "x": X})
    np.testing.assert_array_equal(encoded.state, STATE)
    plain = EncodedObservation(encoded)
    for given in (encoded, plain):
        np.testing.assert_allclose(policy.infer(given).chunk, X + STATE, rtol=1e-6)
    np.testing.assert_array_equal(policy.decode(X[None], encoded), X + STATE)


def test_the_newest_moment_of_a_history_counts(tmp_path: Path) -> None:
    text = "g (float[1,2,3] s, float[1,2,3] x) => (float[1,2,3] y) { y = Sub(x, s) }"
    outputs = (tensor("y", 1, 2, 3, convert=[{"op": "relative", "to": "s"}]),)
    inputs = (tensor("s", 1, 2, 3, history=2), tensor("x", 1, 2, 3))
    policy = load(written(tmp_path, text, inputs, outputs, chunk=2).path)
    policy.observe({"s": STATE, "x": X})
    chunk = policy.infer({"s": STATE + 1, "x": X}).chunk
    np.testing.assert_array_equal(chunk, X - [STATE, STATE + 1] + STATE + 1)
    whole = np.stack([STATE, STATE + 5])
    np.testing.assert_array_equal(policy.infer({"s": whole, "x": X}).chunk, X - whole + STATE + 5)
