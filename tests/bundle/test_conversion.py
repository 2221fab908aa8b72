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
    "overlapping parts": ({}, {"convert": [{**RELATIVE, "parts": ["arm", 0]}]}, "parts that overlap"),
    "relative to nothing": ({}, {"convert": [{"op": "relative"}]}, "needs 'to'"),
    "relative to what is no input": ({}, {"convert": [{**RELATIVE, "to": "t"}]}, "relative to 't', which is no input"),
    "relative to a frame": ({}, {"convert": [{**RELATIVE, "to": "f"}]}, "wanted: a vector of floats"),
    "relative to integers": ({"dtype": "int64"}, {"convert": [RELATIVE]}, "int64 .* wanted: a vector of floats"),
    "relative to a picture": ({"shape": [1, 2, 4]}, {"convert": [RELATIVE]}, "wanted: a vector of floats"),
    "relative to fewer": ({"shape": [1, 2], "labels": [], "parts": {"arm": [0, 2]}}, {"convert": [RELATIVE]},
                          "name as many elements"),
    "relative to a part that the state lacks": ({"parts": {}}, {"convert": [RELATIVE]}, "of the state 's' names the"),
    "all of a longer vector": ({"shape": [1, 3], "labels": []}, {"convert": [{"op": "relative", "to": "s"}]},
                               "which has 3"),
    "more states than parts": ({}, {"convert": [{**RELATIVE, "state": ["a", "b"]}]}, "1 parts and 2 parts of the"),
    "successive by text": ({}, {"convert": [{**RELATIVE, "successive": "yes"}]}, "must be true or false"),
    "a delta that is made absolute": ({}, {"convert": [RELATIVE], "mode": "delta"}, "mode delta, and is made absolute"),
    "a relative state": ({"convert": [{"op": "relative", "to": "s"}]}, {}, "that is for the action 'y' alone"),
    "a place for no statistics": ({}, {"convert": [{"op": "normalisation"}]}, "allowed: one, with a normalisation"),
    "converted integers": ({}, {"dtype": "int64", "convert": [RELATIVE]}, "finite floats alone"),
    "a converted sensor that may fail": ({"finite": False, "convert": [{"op": "normalisation"}]}, {}, "finite floats"),
    "parts of a dynamic vector": ({"shape": [1, "n"], "labels": []}, {}, "vectors of a known width"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_spec_is_one_sentence(name: str) -> None:
    state, action, words = BAD[name]
    with pytest.raises(SpecError, match=words):
        spec(state, action)


@pytest.mark.parametrize("more", [{"image": {"camera": [8, 8]}}, {"kind": "discrete", "labels": ["a", "b", "c", "d"]}])
def test_parts_are_of_vectors(more: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="vectors of a known width"):
        TensorSpec.from_dict(
            {"name": "x", "shape": [1, 3, 8, 8] if "image" in more else [1, 4], "parts": {"p": 0}, **more}
        )
