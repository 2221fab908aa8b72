"""What a spec says of parts of vectors and of conversions, and what it refuses."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError

STATE = {"name": "s", "shape": [1, 4], "labels": ["a", "b", "c", "d"], "parts": {"arm": [0, 3]}}
ACTION: dict[str, Any] = {"name": "y", "shape": [1, 2, 4], "parts": {"arm": [0, 3], "grip": 3}}
FRAME = {"name": "f", "shape": [1, 3, 8, 8], "image": {"camera": [8, 8]}}
RELATIVE = {"op": "relative", "to": "s", "parts": ["arm"]}


def spec(state: dict[str, Any] | None = None, action: dict[str, Any] | None = None) -> PolicySpec:
    """Return a spec of a state, a frame and an action, with changes of the state and of the action."""
    tensors = {"inputs": [{**STATE, **(state or {})}, FRAME], "outputs": [{**ACTION, **(action or {})}]}
    return PolicySpec.from_dict(copy.deepcopy({**tensors, "control_hz": 10, "chunk": 2}))


def test_parts_and_conversions_survive_the_round_trip() -> None:
    made = spec(action={"convert": [RELATIVE], "mode": "absolute"})
    assert made.action.parts == {"arm": (0, 3), "grip": (3, 4)}
    assert PolicySpec.from_dict(made.to_dict()) == made
    assert made.to_dict()["outputs"][0]["convert"] == [RELATIVE]
    assert made.reference == made.inputs[0]
    assert (spec().reference, spec(action={"parts": {}}).action.schema, made.schema) == (None, 1, 2)


def turn(part: str, robot: str, network: str = "axis_angle") -> dict[str, Any]:
    return {"op": "rotation", "parts": [part], "robot": robot, "network": network}


BAD: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "parts of text": ({}, {"parts": "arm"}, "parts of 'y' must be a mapping"),
    "a part of text": ({}, {"parts": {"arm": "0-3"}}, r"part 'arm' of 'y' is '0-3'; wanted: \[START, STOP\]"),
    "a part of three": ({}, {"parts": {"arm": [0, 1, 2]}}, r"is \[0, 1, 2\]; wanted"),
    "an empty part": ({}, {"parts": {"arm": [2, 2]}}, "whole number from 3"),
    "a part from the end": ({}, {"parts": {"arm": -1}}, "whole number from 0; got -1"),
    "a part of fractions": ({}, {"parts": {"arm": [0, 1.5]}}, "whole number"),
    "a part outside": ({}, {"parts": {"arm": [0, 5]}}, "part 4 of a vector of 4 elements"),
    "a part without a name": ({}, {"parts": {"": 1}}, "must be text that is not empty"),
    "a part and a label": ({"parts": {"a": 1}}, {}, "a part and a label of the name 'a'"),
    "steps of text": ({}, {"convert": "relative"}, "'convert' must be a list"),
    "a step of text": ({}, {"convert": ["relative"]}, "A step of 'convert' must be a mapping"),
    "a step without op": ({}, {"convert": [{"to": "s"}]}, "needs 'op'"),
    "an unknown op": ({}, {"convert": [{"op": "relativ", "to": "s"}]}, "did you mean 'relative'"),
    "an op of a number": ({}, {"convert": [{"op": 3}]}, "it must be text"),
    "an unknown key": ({}, {"convert": [{**RELATIVE, "joint": 1}]}, "relative, has the unknown key 'joint'"),
    "a key of another": ({}, {"convert": [{"op": "normalisation", "to": "s"}]}, "which belongs to another"),
    "too many": ({}, {"convert": [RELATIVE] * 33}, "33 steps; allowed: up to 32"),
    "an unknown part": ({}, {"convert": [{**RELATIVE, "parts": ["arms"]}]}, "the part 'arms'; did you mean 'arm'"),
    "a label of two elements": (
        {"labels": ["g", "g", "h", "i"], "convert": [{"op": "scale", "factor": -1, "parts": ["g"]}]}, {},
        "names the part 'g'; known: arm, h, i",
    ),
    "overlapping parts": ({}, {"convert": [{**RELATIVE, "parts": ["arm", 0]}]}, "parts that overlap"),
    "relative to nothing": ({}, {"convert": [{"op": "relative"}]}, "needs 'to'"),
    "relative to what is no input": ({}, {"convert": [{**RELATIVE, "to": "t"}]}, "'t', which is not an input"),
    "relative to a frame": ({}, {"convert": [{**RELATIVE, "to": "f"}]}, "wanted: a vector of floats"),
    "relative to integers": ({"dtype": "int64"}, {"convert": [RELATIVE]}, "int64 .* wanted: a vector of floats"),
    "relative to a picture": ({"shape": [1, 2, 4]}, {"convert": [RELATIVE]}, "wanted: a vector of floats"),
    "relative to fewer": ({"shape": [1, 2], "labels": [], "parts": {"arm": [0, 2]}}, {"convert": [RELATIVE]},
                          "name as many elements"),
    "relative to a part that the state lacks": ({"parts": {}}, {"convert": [RELATIVE]}, "of the state 's' names the"),
    "all of a longer vector": ({"shape": [1, 3], "labels": []}, {"convert": [{"op": "relative", "to": "s"}]},
                               "which has 3"),
    "more states than parts": ({}, {"convert": [{**RELATIVE, "state": ["a", "b"]}]}, "1 part and 2 parts of the"),
    "successive by text": ({}, {"convert": [{**RELATIVE, "successive": "yes"}]}, "must be true or false"),
    "a delta that is made absolute": ({}, {"convert": [RELATIVE], "mode": "delta"}, "mode delta, and is made absolute"),
    "a relative state": ({"convert": [{"op": "relative", "to": "s"}]}, {}, "that is for the action 'y' alone"),
    "a place for no statistics": ({}, {"convert": [{"op": "normalisation"}]}, "allowed: one, with a normalisation"),
    "converted integers": ({}, {"dtype": "int64", "convert": [RELATIVE]}, "finite floats alone"),
    "a converted sensor that may fail": ({"finite": False, "convert": [{"op": "normalisation"}]}, {}, "finite floats"),
    "a pose of no form": ({}, {"convert": [{**RELATIVE, "pose": "rpy"}]}, "has the pose 'rpy'"),
    "a pose of two elements": ({}, {"convert": [{**RELATIVE, "parts": ["a"], "pose": "matrix"}], "labels": [*"abcd"]},
                               "pose of 1 element, .* matrix has 9, and 3 more"),
    "a frame of the world": ({}, {"convert": [{**RELATIVE, "pose": "axis_angle", "frame": "world"}]}, "frame 'world'"),
    "a frame of no pose": ({}, {"convert": [{**RELATIVE, "frame": "base"}]}, "has the pose ''"),
    "a rotation of the whole": ({"convert": [{"op": "rotation", "robot": "matrix", "network": "matrix"}]}, {},
                                "needs 'parts'"),
    "a rotation of another width": (
        {"convert": [turn("arm", "quaternion_xyzw", "quaternion_wxyz")]}, {}, "3 elements, .* quaternion_xyzw has 4"),
    "a rotation of more than there is": (
        {"convert": [turn("arm", "axis_angle", "matrix")]}, {}, "4 elements; its rotations alone have more"),
    "labels of the network": (
        {"convert": [turn("q", "quaternion_xyzw")], "parts": {"q": [0, 4]}}, {}, "a last axis of 5, as the"),
    "an unknown form": ({"convert": [turn("arm", "rotvec")]}, {}, "the side of the robot the form 'rotvec'"),
    "an unknown form of the network": ({"convert": [turn("arm", "axis_angle", "6d")]}, {}, "the network the form '6d'"),
    "Euler axes of one": ({"convert": [turn("arm", "euler_xxy")]}, {}, "the form 'euler_xxy'"),
    "Euler axes of both kinds": ({"convert": [turn("arm", "euler_xYz")]}, {}, "the form 'euler_xYz'"),
    "a hemisphere of a number": ({"convert": [{**turn("arm", "axis_angle"), "hemisphere": 1}]}, {}, "it must be text"),
    "a rotation of normalised values": (
        {"shape": [1, 7], "normalisation": "mean_std", "statistics": "s.json#s",
         "convert": [{"op": "normalisation"}, turn("arm", "axis_angle", "6d_rows")]}, {}, "behind its normalisation"),
    "a label that was turned": (
        {"shape": [1, 7], "convert": [turn("arm", "axis_angle", "6d_rows"), {"op": "scale", "parts": ["b"]}]}, {},
        "names the part 'b'"),
    "a factor of zero": ({"convert": [{"op": "scale", "factor": [1, 0, 1, 1]}]}, {}, "no factor of 0"),
    "a factor that float32 has not": ({"convert": [{"op": "scale", "factor": 1e-40}]}, {}, "no factor of 0"),
    "an offset that float32 has not": ({"convert": [{"op": "scale", "offset": 1e40}]}, {}, r"one is 1e\+40; allowed"),
    "a threshold that float32 has not": ({"convert": [{"op": "binarise", "threshold": -1e39}]}, {}, "which is -1e"),
    "relative to normalised values": (
        {}, {"normalisation": "mean_std", "statistics": "s.json#y", "convert": [{"op": "normalisation"}, RELATIVE]},
        "relative behind its normalisation"),
    "relative to degrees in radians": (
        {"unit": ["deg", "deg", "deg", "1"]},
        {"unit": ["deg", "deg", "deg", "1"], "convert": [{"op": "scale", "parts": [1], "factor": 0.01745}, RELATIVE]},
        r"A step of 'convert', relative, stands behind the step 'scale', and 's' is in deg as the robot has it"),
    "a factor of text": ({"convert": [{"op": "scale", "factor": "-1"}]}, {}, "of which one must be a number; got '-1'"),
    "two factors for four": ({"convert": [{"op": "scale", "factor": [1, -1]}]}, {}, "2 numbers as factor, for 4 elem"),
    "no offset": ({"convert": [{"op": "scale", "offset": []}]}, {}, "wanted: numbers"),
    "an endless offset": ({"convert": [{"op": "scale", "offset": float("inf")}]}, {}, "must be a number; got inf"),
    "a range of one": ({"convert": [{"op": "range", "robot": [0, 1], "network": [1]}]}, {}, "two numbers that differ"),
    "a range of nothing": ({"convert": [{"op": "range", "robot": [0, 0], "network": [0, 1]}]}, {}, "that differ"),
    "a range of a form": ({"convert": [{"op": "range", "robot": "0-1", "network": [0, 1]}]}, {}, "must be a number"),
    "no bounds": ({"convert": [{"op": "clip"}]}, {}, "one of them at least"),
    "bounds in the wrong order": ({"convert": [{"op": "clip", "low": 1, "high": [2, 2, 0, 2]}]}, {}, "lower one as"),
    "three bounds for four": ({"convert": [{"op": "clip", "low": [0, 0, 0]}]}, {}, "3 numbers as low, for 4"),
    "a threshold of text": ({"convert": [{"op": "binarise", "threshold": "0.5"}]}, {}, "has threshold, which must be"),
    "a linkage without an arm": ({"convert": [{"op": "linkage", "horn_radius": 0.02}]}, {}, "needs arm_length in m"),
    "a linkage of centimetres below zero": (
        {"convert": [{"op": "linkage", "horn_radius": -2, "arm_length": 3}]}, {}, "needs horn_radius in m"),
    "a bound of another op": ({"convert": [{"op": "scale", "low": 0}]}, {}, "'low', which belongs to another; scale"),
    "parts of a dynamic vector": ({"shape": [1, "n"], "labels": []}, {}, "vectors of a known width"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_spec_is_one_sentence(name: str) -> None:
    state, action, words = BAD[name]
    with pytest.raises(SpecError, match=words):
        spec(state, action)


@pytest.mark.parametrize(("unit", "steps"), [
    ("deg", [RELATIVE, {"op": "scale", "factor": 0.01745}]),  # differences are scaled
    ("deg", [{"op": "scale", "parts": ["grip"], "factor": 2}, RELATIVE]),  # another part
    ("deg", [{"op": "clip", "low": -180}, RELATIVE]),
    ("rad", [{"op": "scale", "factor": 57.3}, RELATIVE]),  # the robot says degrees, and takes radians
    ("", [{"op": "scale", "factor": 57.3}, RELATIVE]),  # nobody knows
])  # fmt: skip
def test_what_is_relative_has_the_units_of_the_state(unit: str, steps: list[dict[str, Any]]) -> None:
    assert spec({"unit": "deg"}, {"unit": unit, "convert": steps}).reference is not None


def test_the_shape_is_the_networks_and_all_else_the_robots() -> None:
    arms = ("left", "right")
    said = {
        "labels": [f"{arm}_{axis}" for arm in arms for axis in ("x", "y", "z", "rx", "ry", "rz", "grip")],
        "parts": {name: [at, at + 7] for name, at in (("left", 0), ("right", 7))} | {"a": [3, 6], "b": [10, 13]},
        "unit": ["m", "m", "m", "rad", "rad", "rad", "1"] * 2,
    }
    steps = [
        {"op": "rotation", "parts": ["b", "a"], "robot": "axis_angle", "network": "6d_rows"},
        {"op": "scale", "parts": ["left_grip", "right_grip"], "factor": [-1, 1]},
        {"op": "clip", "parts": ["right", [9, 10]], "low": 0},
    ]
    tensor = TensorSpec.from_dict({"name": "x", "shape": [1, 20], "convert": steps, **said})
    assert (tensor.robot_width, tensor.width, len(tensor.units())) == (14, 20, 14)
    robot, turned, *_, network = tensor.layouts()
    assert (robot.width, network.width) == (14, 20)
    assert {name: turned.names[name] for name in ("left", "a", "left_grip", "right", "b", "right_grip")} == {
        "left": (0, 10), "a": (3, 9), "left_grip": (9, 10), "right": (10, 20), "b": (13, 19), "right_grip": (19, 20),
    }  # fmt: skip
    assert "left_rx" not in turned.names
    assert tensor.observation.shape == (1, 14)


@pytest.mark.parametrize("more", [{"image": {"camera": [8, 8]}}, {"kind": "discrete", "labels": ["a", "b", "c", "d"]}])
def test_parts_are_of_vectors(more: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="vectors of a known width"):
        TensorSpec.from_dict(
            {"name": "x", "shape": [1, 3, 8, 8] if "image" in more else [1, 4], "parts": {"p": 0}, **more}
        )
