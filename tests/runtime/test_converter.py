"""Actions and states that mean another thing to the robot than to the network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _written import written

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, GraphError, SpecError
from vlatool.runtime import Policy, load
from vlatool.runtime.converter import action_converter
from vlatool.runtime.observation import EncodedObservation, ObservationEncoder

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
    (tmp_path / "stats.json").write_text(json.dumps(STATISTICS))
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


def both_ways(tmp_path: Path, width: int, *convert: dict[str, Any], robot: int = 0, **more: Any) -> tuple[Any, Any]:
    """Return the functions to the network and to the robot of an action of so many elements in the network."""
    spec = PolicySpec((tensor("s", 1, 3),), (tensor("y", 1, width, convert=list(convert), **more),), 10)
    converter = action_converter(spec, tmp_path)
    return converter.to_network, converter.to_robot


@pytest.mark.parametrize(
    ("step", "robot", "network"),
    [
        ({"op": "scale", "factor": [1, -1, 1]}, [1, 2, 3], [1, -2, 3]),
        ({"op": "scale", "parts": [2, 0], "factor": [2, 10], "offset": 1}, [1, 2, 3], [11, 2, 7]),
        ({"op": "scale", "factor": 57.29578, "parts": [[0, 2]]}, [np.pi, 1, 1], [180, 57.29578, 1]),
        ({"op": "range", "parts": [2], "robot": [0, 0.08], "network": [-1, 1]}, [5, 5, 0.06], [5, 5, 0.5]),
        ({"op": "range", "parts": [2], "robot": [0, 1], "network": [1, -1]}, [5, 5, 0.25], [5, 5, 0.5]),
        ({"op": "clip", "low": [0, 0, 0], "high": 4}, [1, 2, 3], [1, 2, 3]),
    ],
)
def test_a_step_goes_both_ways(tmp_path: Path, step: dict[str, Any], robot: Any, network: Any) -> None:
    to_network, to_robot = both_ways(tmp_path, 3, step)
    given = np.array([robot], np.float32)
    np.testing.assert_allclose(to_network(given), [network], rtol=1e-6)
    np.testing.assert_allclose(to_robot(np.array([network], np.float32)), [robot], rtol=1e-6)
    np.testing.assert_array_equal(given, np.array([robot], np.float32))
    assert to_network(given).dtype == np.float32


def test_actions_are_clipped(tmp_path: Path) -> None:
    _, to_robot = both_ways(tmp_path, 3, {"op": "clip", "low": [-1, -2, -3], "high": [1, 2, 3]})
    np.testing.assert_array_equal(to_robot(np.array([[9, -9, 2]], np.float32)), [[1, -2, 2]])
    _, to_robot = both_ways(tmp_path, 3, {"op": "clip", "parts": [1], "high": 0})
    np.testing.assert_array_equal(to_robot(np.array([[9, 9, -2]], np.float32)), [[9, 0, -2]])


def openvla(grip: Any) -> Any:
    """OpenVLA's gripper on LIBERO: 0 to 1 (open), binarised to -1 or 1, and its sign turned (-1 is open)."""
    return -np.sign(2 * (grip - 0) / (1 - 0) - 1)


def test_the_gripper_of_openvla_on_libero(tmp_path: Path) -> None:
    steps = [
        {"op": "scale", "parts": "grip", "factor": -1},
        {"op": "binarise", "parts": "grip", "equal": 0},
        {"op": "range", "parts": "grip", "robot": [-1, 1], "network": [0, 1]},
    ]
    to_network, to_robot = both_ways(tmp_path, 3, *steps, labels=["x", "y", "grip"])
    grips = np.array([0, 0.2, 0.5, 0.500001, 0.9, 1], np.float32)
    found = to_robot(np.stack([grips + 5, grips - 5, grips], axis=1))
    np.testing.assert_array_equal(found[:, 2], openvla(grips))
    np.testing.assert_array_equal(found[:, 0], grips + 5)
    with pytest.raises(SpecError, match="binarise, has no way back"):
        to_network(found)


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ({"threshold": 0.5, "above": -1, "below": 1}, [1, 1, 1, -1]),  # vla_jepa_binarize_gripper of LeRobot
        ({"threshold": 0.5, "above": 1, "below": 0, "equal": 1}, [0, 0, 1, 1]),  # its vla_jepa_pre_snap_gripper
        ({"threshold": 0.5}, [-1, -1, -1, 1]),  # that of X-VLA on LIBERO
        ({}, [-1, 1, 1, 1]),
    ],
)
def test_a_threshold(tmp_path: Path, step: dict[str, Any], expected: list[float]) -> None:
    _, to_robot = both_ways(tmp_path, 1, {"op": "binarise", **step})
    found = to_robot(np.array([[0], [0.3], [0.5], [0.7]], np.float32))
    np.testing.assert_array_equal(found[:, 0], expected)


def test_a_threshold_of_normalised_values(tmp_path: Path) -> None:
    (tmp_path / "stats.json").write_text('{"y": {"mean": [10], "std": [2]}}')
    steps = [{"op": "normalisation"}, {"op": "binarise", "threshold": 0.25, "below": 0}]
    _, to_robot = both_ways(tmp_path, 1, *steps, normalisation="mean_std", statistics="stats.json#y")
    np.testing.assert_array_equal(to_robot(np.array([[0.2], [0.3]], np.float32)), [[10], [12]])


def test_the_linkage_of_aloha(tmp_path: Path) -> None:
    to_network, to_robot = both_ways(tmp_path, 1, {"op": "linkage", "arm_length": 0.036, "horn_radius": 0.022})
    positions = np.linspace(0.01844, 0.058, 50, dtype=np.float32)[:, None]
    angles = to_network(positions)
    inside = (0.022**2 + positions**2 - 0.036**2) / (2 * 0.022 * positions)
    np.testing.assert_allclose(angles, np.arcsin(np.clip(inside, -1, 1)), rtol=1e-5)
    np.testing.assert_allclose(to_robot(angles), positions, rtol=1e-4)
    assert np.isfinite(to_network(np.array([[0.0], [-0.1], [1e-30], [9]], np.float32))).all()


def test_two_arms_with_rotations_of_other_forms(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    parts = {"left": [3, 6], "right": [10, 13]}
    steps = [
        {"op": "rotation", "parts": ["right", "left"], "robot": "axis_angle", "network": "6d_columns"},
        {"op": "scale", "parts": [9, 19], "factor": [2, 4]},
    ]
    to_network, to_robot = both_ways(tmp_path, 20, *steps, parts=parts)
    turns = Rotation.random(8, rng=1)
    left, right = turns[:4].as_rotvec(), turns[4:].as_rotvec()
    ones = np.ones((4, 1))
    robot = np.concatenate([ones * [1, 2, 3], left, 4 * ones, ones * [5, 6, 7], right, 8 * ones], axis=1)
    columns = [each.as_matrix()[:, :, :2].swapaxes(1, 2).reshape(-1, 6) for each in (turns[:4], turns[4:])]
    network = np.concatenate([ones * [1, 2, 3], columns[0], 8 * ones, ones * [5, 6, 7], columns[1], 32 * ones], axis=1)
    np.testing.assert_allclose(to_network(robot.astype(np.float32)), network, atol=1e-6)
    np.testing.assert_allclose(to_robot(network.astype(np.float32)), robot, atol=3e-6)
    np.testing.assert_allclose(to_robot(to_network(robot)), robot, atol=1e-12)


def test_a_state_is_converted_before_it_is_normalised_and_labels_are_the_robots(tmp_path: Path) -> None:
    text = "g (float[1,3] s, float[1,2,3] x) => (float[1,2,3] y, float[1,3] z) { y = Identity(x)  z = Identity(s) }"
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/stats.json").write_text('{"s": {"mean": [1, 1, 1], "std": [2, 2, 2]}}')
    turn = {"op": "rotation", "parts": "q", "robot": "quaternion_wxyz", "network": "axis_angle"}
    by_mean = {"normalisation": "mean_std", "statistics": "stats.json#s"}
    inputs = (tensor("s", 1, 3, convert=[turn], parts={"q": [0, 4]}, **by_mean), tensor("x", 1, 2, 3))
    policy = load(written(tmp_path, text, inputs, (tensor("y", 1, 2, 3), tensor("z", 1, 3)), chunk=2).path)
    for sign in (1, -1):
        seen = policy.infer({"s": sign * np.array([0, 0, 1, 0]), "x": X}).outputs["z"]
        np.testing.assert_allclose(np.abs(seen * 2 + 1), [[0, np.pi, 0]], atol=1e-6)
    for wrong, words in (
        ([0, 0, 0, 0], "not a rotation"),
        ([1, 0, 0], r"takes \[1, 4\]"),
        ([np.nan, 0, 0, 0], "1 NaN"),
    ):
        with pytest.raises(DataError, match=words):
            policy.infer({"s": np.array(wrong, np.float32), "x": X})


def test_what_is_no_rotation_is_no_action(tmp_path: Path) -> None:
    turn = {"op": "rotation", "parts": [[0, 3]], "robot": "axis_angle", "network": "6d_rows"}
    text = "g (float[1,6] x) => (float[1,6] y) { y = Identity(x) }"
    policy = load(written(tmp_path, text, (tensor("x", 1, 6),), (tensor("y", 1, 6, convert=[turn]),)).path)
    assert policy.infer({"x": [1, 0, 0, 0, 1, 0]}).chunk.tolist() == [[0, 0, 0]]
    with pytest.raises(GraphError, match="'y' is not finite"):
        policy.infer({"x": np.zeros(6)})


@pytest.mark.parametrize("step", [{"op": "binarise"}, {"op": "clip", "low": -1, "high": 1}])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_number_does_not_become_an_action(tmp_path: Path, step: dict[str, Any], value: float) -> None:
    text = "g (float[1,2] x) => (float[1,2] y) { y = Identity(x) }"
    policy = load(
        written(tmp_path, text, (tensor("x", 1, 2, finite=False),), (tensor("y", 1, 2, convert=[step]),)).path
    )
    with pytest.raises(GraphError, match="'y' is not finite"):
        policy.infer({"x": np.array([value, 1], np.float32)})


def test_moments_of_a_history_are_converted_one_by_one(tmp_path: Path) -> None:
    text = "g (float[1,2,3] s, float[1,2,3] x) => (float[1,2,3] y) { y = Identity(s) }"
    turn = {"op": "rotation", "parts": [[0, 4]], "robot": "quaternion_wxyz", "network": "axis_angle"}
    inputs = (tensor("s", 1, 2, 3, history=2, convert=[turn]), tensor("x", 1, 2, 3))
    policy = load(written(tmp_path, text, inputs, (tensor("y", 1, 2, 3),), chunk=2).path)
    first, second = np.array([1, 0, 0, 0]), np.array([0, 0, 5, 0])
    policy.observe({"s": first, "x": X})
    np.testing.assert_allclose(policy.infer({"s": second, "x": X}).chunk, [[0, 0, 0], [0, np.pi, 0]], atol=1e-6)
    whole = np.stack([second, first]).astype(np.float32)
    np.testing.assert_allclose(policy.infer({"s": whole, "x": X}).chunk, [[0, np.pi, 0], [0, 0, 0]], atol=1e-6)


def test_a_half_precision_state_is_converted_in_single_precision(tmp_path: Path) -> None:
    degrees = {"op": "scale", "factor": 1 / 1000, "offset": -65.5}
    half = tensor("s", 1, 3, dtype="float16", convert=[degrees])
    encode = ObservationEncoder(PolicySpec((half,), (tensor("y", 1, 1),), 10), tmp_path)
    seen = encode({"s": [65504, 65510, 70000]})["s"]
    assert seen.dtype == np.float16
    np.testing.assert_allclose(seen, [[0.004, 0.01, 4.5]], rtol=1e-2)
    with pytest.raises(DataError, match="too large for float16"):
        encode({"s": [0, 0, 1e9]})
