from typing import Any

import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError

IMAGE = {"name": "image", "shape": [1, 8, 8, 3], "dtype": "uint8", "unit": "rgb"}
STATE = {"name": "state", "shape": [1, 2], "unit": ["m", "rad"], "normalisation": "min_max", "statistics": "s.json#x"}
TEXT = {"name": "say", "kind": "text", "tokenizer": "words.json", "max_tokens": 5}
ACTION = {"name": "action", "shape": [1, 4, 2], "labels": ["dx", "dy"], "mode": "delta"}
LOGITS = {"name": "logits", "kind": "discrete", "shape": [1, 3], "labels": ["left", "right", "forward"]}
SPECS = [
    {"inputs": [IMAGE], "outputs": [ACTION], "control_hz": 20},
    {"inputs": [IMAGE, STATE, TEXT], "outputs": [ACTION], "control_hz": 12.5, "chunk": 4, "execute": 2},
    {
        "inputs": [{"name": "cloud", "shape": [1, "points", 3], "dtype": "float16"}],
        "outputs": [LOGITS],
        "control_hz": 5,
    },
    {"inputs": [STATE], "outputs": [LOGITS, {"name": "value", "shape": [1, 1]}], "control_hz": 1},
]


@pytest.mark.parametrize("data", SPECS)
def test_a_spec_survives_the_round_trip(data):
    spec = PolicySpec.from_dict(data)
    assert PolicySpec.from_dict(spec.to_dict()) == spec
    assert spec.to_dict() == PolicySpec.from_dict(spec.to_dict()).to_dict()


def test_only_what_differs_from_the_defaults_is_written():
    assert PolicySpec.from_dict(SPECS[0]).to_dict() == SPECS[0]


def test_a_prompt_is_part_of_a_text_input_and_comes_back():
    prompt = {"template": "In: {}? {state}", "lower": True, "last": 29871, "strip": True, "replace": {"_": " "},
              "state": {"input": "joints", "low": -2, "bins": 8}}  # fmt: skip
    text = TensorSpec.from_dict({**TEXT, "prompt": prompt})
    assert text.to_dict()["prompt"] == prompt
    assert TensorSpec.from_dict(text.to_dict()) == text
    assert (text.schema, TensorSpec.from_dict(TEXT).schema) == (2, 1)


@pytest.mark.parametrize(("prompt", "words"), [
    ({"template": "In"}, "it has {} once"), ({"template": "{} {}"}, "it has {} once"), ({"lower": 1}, "has lower 1"),
    ({"last": -1}, "last id of a prompt"), ({"last": 2.5}, "last id of a prompt"), ("In: {}", "must be a mapping"),
    ({"templat": "{}"}, "did you mean 'template'"), ({"template": None}, "template of a prompt must be text"),
    ({"strip": "no"}, "has strip 'no'"), ({"replace": {"ab": "c"}}, "one character"), ({"replace": {"a": 1}}, "one"),
    ({"replace": ["_"]}, "What a prompt replaces must be a mapping"),
    ({"state": {"input": "x"}}, r"it has \{state\} once, for the state"),
    ({"template": "{} {state} {state}", "state": {"input": "x"}}, r"it has \{state\} once"),
    *(({"template": "{} {state}", "state": state}, words) for state, words in [
        ({}, "input of a prompt's state"), ({"input": "x", "bins": 0}, "bins of a prompt's state"),
        ({"input": "x", "bins": 1 << 20}, "allowed: 1 to 65536"), ({"input": "x", "low": 2}, "low below high"),
        ({"input": "x", "low": float("nan")}, "low of a prompt's state"), ("x", "must be a mapping"),
        ({"inputs": "x"}, "did you mean 'input'"),
    ]),
])  # fmt: skip
def test_an_impossible_prompt_is_refused(prompt: object, words: str):
    with pytest.raises(SpecError, match=words):
        TensorSpec.from_dict({**TEXT, "prompt": prompt})


def test_only_a_text_has_a_prompt():
    with pytest.raises(SpecError, match="belongs to kind: text"):
        TensorSpec.from_dict({"name": "state", "shape": [1, 3], "prompt": {"template": "{}"}})


IN_PROMPT = {**TEXT, "prompt": {"template": "{} {state}", "state": {"input": "joints"}}}


@pytest.mark.parametrize(("joints", "words"), [
    ({"name": "joint", "shape": [1, 3]}, "which is not an input; did you mean 'joint'"),
    ({"name": "joints", "shape": [1, 3], "dtype": "int64"}, r"int64 \[1, 3\]; wanted: floats of one moment"),
    ({"name": "joints", "shape": [1, 2, 3], "history": 2}, r"float32 \[1, 2, 3\]; wanted"),
    ({**TEXT, "name": "joints"}, "int64"),
])  # fmt: skip
def test_a_prompt_has_a_vector_of_the_spec_in_it_or_is_refused(joints: dict[str, Any], words: str):
    outputs = [{"name": "y", "shape": [1, 1]}]
    right = {"name": "joints", "shape": [1, 3]}
    PolicySpec.from_dict({"inputs": [IN_PROMPT, right], "outputs": outputs, "control_hz": 10})
    with pytest.raises(SpecError, match=words):
        PolicySpec.from_dict({"inputs": [IN_PROMPT, joints], "outputs": outputs, "control_hz": 10})


def test_a_text_input_sees_ids_of_its_width():
    text = TensorSpec.from_dict(TEXT)
    assert (text.dtype, text.shape) == ("int64", (1, 5))


def test_width_elements_and_units():
    state, cloud = TensorSpec.from_dict(STATE), TensorSpec("cloud", (1, "points", 3), unit="m")
    assert (state.width, state.elements, state.units()) == (2, 2, ("m", "rad"))
    assert (cloud.width, cloud.elements, cloud.units()) == (3, 3, ("m", "m", "m"))
    assert TensorSpec("free", (1, "n")).width == 0
    assert TensorSpec("scalar", ()).width == 0


def test_the_action_is_the_first_output_and_the_rate_follows_from_what_is_executed():
    spec = PolicySpec.from_dict(SPECS[1])
    assert spec.action.name == "action"
    assert spec.inference_hz == pytest.approx(6.25)
    assert PolicySpec.from_dict({**SPECS[1], "execute": 0}).inference_hz == pytest.approx(12.5 / 4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": ""}, "name of a tensor must be text"),
        ({"name": 3}, "name of a tensor must be text .*got 3"),
        ({"dtype": "float23"}, "dtype 'float23'; did you mean 'float32'"),
        ({"kind": "tekst"}, "kind 'tekst'; did you mean 'text'"),
        ({"normalisation": "meanstd"}, "normalisation 'meanstd'; did you mean 'mean_std'"),
        ({"mode": "deltas"}, "mode 'deltas'; did you mean 'delta'"),
        ({"shape": [1, 0]}, "an axis is a whole number from 1"),
        ({"shape": [1, 2.5]}, "an axis is a whole number from 1"),
        ({"shape": [True, 2]}, "an axis is a whole number from 1"),
        ({"shape": 4}, "needs 'name' and 'shape'"),
        ({"shape": None}, "needs 'name' and 'shape'"),
        ({"labels": ["a", "b", "c"]}, "3 labels for a last axis of 2"),
        ({"unit": ["m"]}, "1 unit for a last axis of 2"),
        ({"normalisation": "mean_std"}, "'statistics' is ''"),
        ({"normalisation": "mean_std", "statistics": "stats.json"}, "FILE#KEY"),
        ({"kind": "discrete", "shape": [1, "n"]}, "needs 'labels'"),
        ({"kind": "discrete", "labels": []}, "needs 'labels'"),
        ({"kind": "discrete", "shape": [1, True]}, "an axis is a whole number|needs 'labels'"),
        ({"kind": "discrete", "shape": [1, 10**15]}, "limit 'elements'"),
        ({"colour": "red"}, "unknown key 'colour'"),
        ({"shape": [1, 10**9]}, "1000000000 elements; the limit 'elements'"),
        ({"shape": [2**62, 2**62]}, "more than 2"),
        ({"name": "\ud800"}, "half of a character"),
        ({"labels": [1, 2]}, "label or unit of 'state' must be text"),
        ({"dtype": ["float32"]}, "it must be text"),
        ({"kind": "text", "tokenizer": "words.json", "max_tokens": 10**9}, "limit 'tokens'"),
        ({"kind": "text", "tokenizer": "words.json", "max_tokens": True}, "max_tokens of 'state' must be a whole"),
        ({"shpe": [1]}, "unknown key 'shpe'; did you mean 'shape'"),
    ],
)
def test_an_impossible_tensor_is_refused(change, message):
    with pytest.raises(SpecError, match=message) as caught:
        TensorSpec.from_dict({"name": "state", "shape": [1, 2], **change})
    assert caught.value.exit_code == 3


def test_a_discrete_output_without_labels_has_the_indices_as_labels():
    tokens = TensorSpec.from_dict({"name": "tokens", "kind": "discrete", "shape": [1, 7, 256]})
    assert tokens.labels == tuple(str(index) for index in range(256))
    assert TensorSpec.from_dict(tokens.to_dict()) == tokens


@pytest.mark.parametrize(
    ("file", "reason"),
    [
        ("../words.json", "leaves the directory"),
        ("deep/../../words.json", "leaves the directory"),
        ("/etc/passwd", "is absolute"),
        ("..", "leaves the directory"),
        ("C:\\words.json", "characters that no file"),
        ("..\\words.json", "characters that no file"),
        ("words\0.json", "characters that no file"),
        ("./words.json", "empty or a dot"),
        ("deep//words.json", "empty or a dot"),
        ("x" * 300, "too long"),
    ],
)
def test_a_file_that_is_not_in_the_folder_is_refused(file, reason):
    with pytest.raises(SpecError, match=reason):
        TensorSpec.from_dict({**TEXT, "tokenizer": file})
    with pytest.raises(SpecError, match=reason):
        TensorSpec.from_dict({**STATE, "statistics": f"{file}#x"})


def test_the_files_of_a_tensor():
    assert TensorSpec.from_dict(TEXT).assets() == ["words.json"]
    assert TensorSpec.from_dict(STATE).assets() == ["s.json"]
    assert TensorSpec.from_dict(IMAGE).assets() == []


@pytest.mark.parametrize("change", [{"tokenizer": ""}, {"max_tokens": 0}])
def test_a_text_input_needs_tokenizer_and_width(change):
    with pytest.raises(SpecError, match=r"text input 'say' needs 'tokenizer'.*'max_tokens'"):
        TensorSpec.from_dict({**TEXT, "shape": [1, 5], **change})


@pytest.mark.parametrize(
    "change",
    [
        {"statistics": 5, "normalisation": "mean_std"},
        {"kind": "text", "tokenizer": "words.json", "max_tokens": "many", "shape": [1, 5]},
        {"labels": "xy"},
        {"labels": 7},
    ],
    ids=str,
)
def test_a_value_of_a_wrong_type_is_a_spec_error_and_no_traceback(change):
    with pytest.raises(SpecError):
        TensorSpec.from_dict({"name": "state", "shape": [1, 2], **change})


@pytest.mark.parametrize("data", [None, "image", 3, ["image"]])
def test_a_tensor_must_be_a_mapping(data):
    with pytest.raises(SpecError, match="must be a mapping"):
        TensorSpec.from_dict(data)


def test_a_tensor_without_a_name_is_refused():
    with pytest.raises(SpecError, match="needs 'name'"):
        TensorSpec.from_dict({"shape": [1, 2]})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": []}, "at least one input"),
        ({"outputs": []}, "at least one input and one output"),
        ({"inputs": None}, "needs 'inputs', a list"),
        ({"outputs": {"name": "action"}}, "needs 'outputs', a list"),
        ({"inputs": [IMAGE, IMAGE]}, "'image' occurs 2 times"),
        ({"outputs": [{**ACTION, "name": "image"}]}, "'image' occurs 2 times"),
        ({"control_hz": 0}, "control_hz is 0; allowed: a rate in Hz above 0 and below 100,000"),
        ({"control_hz": float("inf")}, "control_hz is inf; allowed: a rate in Hz above 0 and below 100,000"),
        ({"control_hz": 2e5}, "control_hz is 200000.0; allowed: a rate in Hz above 0 and below 100,000"),
        ({"control_hz": -1.0}, "control_hz is -1.0"),
        ({"control_hz": float("nan")}, "control_hz is nan; allowed: a rate"),
        ({"control_hz": True}, "control_hz is True; allowed: a rate"),
        ({"control_hz": "fast"}, "control_hz is 'fast'; allowed: a rate"),
        ({"chunk": 0}, "chunk must be a whole number from 1; got 0"),
        ({"chunk": 2.0}, "chunk must be a whole number from 1; got 2.0"),
        ({"chunk": 2, "execute": 3}, "execute 3"),
        ({"chunks": 2}, "unknown key 'chunks'; did you mean 'chunk'"),
    ],
)
def test_an_impossible_spec_is_refused(change, message):
    with pytest.raises(SpecError, match=message):
        PolicySpec.from_dict({**SPECS[0], **change})


MOMENTS = {"name": "state", "shape": [1, 2, 6], "history": 2}


def test_an_input_may_hold_several_moments():
    tensor = TensorSpec.from_dict(MOMENTS)
    assert tensor.moment == TensorSpec("state", (1, 6))
    assert TensorSpec.from_dict(tensor.to_dict()) == tensor
    assert "history" not in TensorSpec("state", (1, 6)).to_dict()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"history": 1, "shape": [1, 1, 6]}, "history 1 and, as tensor, the shape"),
        ({"history": 3}, r"history 3 .* shape \[1, 2, 6\]; the second axis of a tensor with a history counts"),
        ({"history": -2}, "history of 'state' must be a whole number"),
        ({"history": True}, "history of 'state'"),
        ({"history": 2.0}, "history of 'state'"),
        ({"history": 2, "shape": [2]}, "history 2"),
        ({"history": 2, "shape": []}, "history 2"),
        ({"shape": [1, 2, "n"]}, "history and the dynamic shape"),
        ({"image": {"frame": "rgb", "layout": "hwc", "camera": [8, 8]}}, "an image of the layout hwc has 3 axes"),
        ({"image": {"camera": [8, 8]}, "shape": [1, 2, 5, 3, 8, 8]}, "only axes of 1"),
        ({"image": {"camera": [8, 8]}, "shape": [1, 3, 3, 8, 8]}, "history 2"),
        ({"image": {"camera": [8, 8]}, "shape": [1, 2, 3, "h", 8]}, "dynamic shape"),
        ({"shape": [1, 2], "kind": "text", "tokenizer": "w.json", "max_tokens": 2}, "history 2 and, as text"),
    ],
)
def test_an_impossible_history_is_refused(change, message):
    with pytest.raises(SpecError, match=message):
        TensorSpec.from_dict({**MOMENTS, **change})


def test_an_output_has_no_history():
    with pytest.raises(SpecError, match="output 'action' has a history"):
        PolicySpec.from_dict({**SPECS[0], "outputs": [{"name": "action", "shape": [1, 2, 6], "history": 2}]})


def test_a_spec_needs_its_rate():
    with pytest.raises(SpecError, match="needs 'control_hz'"):
        PolicySpec.from_dict({"inputs": [IMAGE], "outputs": [ACTION]})


def test_a_step_count_of_a_wrong_type_is_a_spec_error_and_no_traceback():
    with pytest.raises(SpecError):
        PolicySpec.from_dict({**SPECS[0], "execute": "all"})


@pytest.mark.parametrize(("name", "got"), [("unit", "1 unit"), ("labels", "1 label")])
def test_one_of_a_kind_is_singular(name: str, got: str):
    with pytest.raises(SpecError, match=f"has {got} for a last axis of 2"):
        TensorSpec("y", (1, 2), **{name: ("m",)})
    with pytest.raises(SpecError, match=f"has 3 {got[2:]}s for a last axis of 2"):
        TensorSpec("y", (1, 2), **{name: ("m", "n", "o")})
