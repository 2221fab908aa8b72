import json
from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, SpecError
from vlatool.runtime.observation import ObservationEncoder

OUT = (TensorSpec("action", (1, 2)),)
GOOD = {"image": np.zeros((2, 2, 3), np.uint8), "state": np.zeros(2, np.float32), "say": "go home", "count": 3}


def encoder(folder: Path, *tensors: TensorSpec) -> ObservationEncoder:
    words = {"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2, "home": 3}}
    (folder / "words.json").write_text(json.dumps(words))
    (folder / "stats.json").write_text(json.dumps({"state": {"mean": [1.0, 2.0], "std": [2.0, 4.0]}}))
    return ObservationEncoder(PolicySpec(tensors, OUT, 10.0), folder)


@pytest.fixture
def encode(tmp_path: Path) -> ObservationEncoder:
    return encoder(
        tmp_path,
        TensorSpec("image", (1, 2, 2, 3), "uint8"),
        TensorSpec("state", (1, 2), normalisation="mean_std", statistics="stats.json#state"),
        TensorSpec("say", (1, 3), "int64", kind="text", tokenizer="words.json", max_tokens=3),
        TensorSpec("count", (1,), "int64"),
    )


@pytest.mark.parametrize("batched", [True, False])
def test_the_batch_axis_may_be_left_out(encode, batched):
    state = np.array([3.0, -2.0], np.float32)
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    values = {"image": image, "state": state}
    given = {name: value[None] if batched else value for name, value in values.items()}
    got = encode({**given, "say": "go home", "count": [3] if batched else 3})
    np.testing.assert_array_equal(got["image"], image[None])
    np.testing.assert_array_equal(got["state"], [[1.0, -1.0]])
    np.testing.assert_array_equal(got["say"], [[2, 3, 0]])
    np.testing.assert_array_equal(got["count"], [3])
    assert [got[name].dtype for name in ("image", "state", "say", "count")] == [
        np.uint8,
        np.float32,
        np.int64,
        np.int64,
    ]


def test_the_observation_itself_is_not_changed(encode):
    state = np.ones(2, np.float32)
    encode({**GOOD, "state": state})
    np.testing.assert_array_equal(state, [1, 1])


def test_what_the_policy_does_not_take_is_passed_over(encode):
    assert set(encode({**GOOD, "battery": 0.5})) == {"image", "state", "say", "count"}


@pytest.mark.parametrize("name", ["image", "state", "say", "count"])
def test_a_missing_input_is_named_with_what_is_there(encode, name):
    rest = {key: value for key, value in GOOD.items() if key != name}
    with pytest.raises(DataError, match=f"no '{name}' \\(it has: {', '.join(rest)}\\); the policy takes image, state"):
        encode(rest)


def test_an_empty_observation(encode):
    with pytest.raises(DataError, match="it has: nothing"):
        encode({})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("image", np.zeros((2, 2, 3), np.float32), "'image' is float32; the policy takes uint8"),
        ("image", np.zeros((2, 2, 3), np.int64), "'image' is int64; the policy takes uint8"),
        ("state", np.array([True, False]), "'state' is bool; the policy takes float32"),
        ("state", np.zeros(2, np.complex64), "'state' is complex64; the policy takes float32"),
        ("state", None, "'state' is object; the policy takes float32"),
        ("state", ["a", "b"], "the policy takes float32"),
        ("count", 1.5, "'count' is float64; the policy takes int64"),
        ("count", np.zeros((), np.uint64), "'count' is uint64; the policy takes int64"),
    ],
)
def test_a_dtype_that_would_change_what_values_mean_is_refused(encode, name, value, message):
    with pytest.raises(DataError, match=message) as caught:
        encode({**GOOD, name: value})
    assert caught.value.fix


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int32, np.uint8])
def test_numbers_are_widened_to_float(encode, dtype):
    np.testing.assert_array_equal(encode({**GOOD, "state": np.array([5, 10], dtype)})["state"], [[2.0, 2.0]])


@pytest.mark.parametrize("dtype", [np.int8, np.int32, np.uint8, np.uint32])
def test_whole_numbers_are_widened(encode, dtype):
    assert encode({**GOOD, "count": dtype(7)})["count"].dtype == np.int64


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("image", (3, 2, 2)),
        ("image", (2, 2, 2, 3)),
        ("image", (2, 2)),
        ("state", (3,)),
        ("state", (1, 1, 2)),
        ("state", ()),
    ],
)
def test_a_wrong_shape_is_told(encode, name, shape):
    value = np.zeros(shape, np.uint8 if name == "image" else np.float32)
    with pytest.raises(DataError, match=f"'{name}' has the shape .*; the policy takes .*first axis may be left out"):
        encode({**GOOD, name: value})


def test_a_ragged_list_is_told(encode):
    with pytest.raises(DataError, match="'state'"):
        encode({**GOOD, "state": [[1.0], [2.0, 3.0]]})


def test_nan_and_infinity_are_counted(encode):
    with pytest.raises(DataError, match="'state' holds 1 NaN of 2 values") as caught:
        encode({**GOOD, "state": [np.nan, np.inf]})
    assert "sensor" in caught.value.fix
    with pytest.raises(DataError, match="'state' holds infinity in 2 of 2"):
        encode({**GOOD, "state": [np.inf, -np.inf]})


def test_what_is_too_large_for_the_dtype_is_not_called_infinity(encode):
    """A warning of numpy would be an error here; infinity itself stays infinity."""
    with pytest.raises(DataError, match=r"'state' has values that are too large for float32 .*: up to 1e\+300"):
        encode({**GOOD, "state": [1e300, 0.0]})
    with pytest.raises(DataError, match=r"'state' holds infinity in 1 of 2"):
        encode({**GOOD, "state": [np.inf, 0.0]})


def test_what_is_too_large_once_it_is_normalised_is_told(tmp_path: Path):
    (tmp_path / "narrow.json").write_text(json.dumps({"far": {"mean": [0.0, 0.0], "std": [1e-3, 1e-3]}}))
    far = TensorSpec("far", (1, 2), normalisation="mean_std", statistics="narrow.json#far")
    encode = ObservationEncoder(PolicySpec((far,), OUT, 10.0), tmp_path)
    for given in (np.float32([3e38, 0]), np.float32([[3e38, 0]])):
        with pytest.raises(DataError, match=r"'far' has values that are too large for float32 .*up to 3e\+38"):
            encode({"far": given})


@pytest.mark.parametrize("value", [3, None, b"go", ["go"], np.array(["go", "home"]), np.zeros((1, 3), np.int64)])
def test_text_must_be_text(encode, value):
    with pytest.raises(DataError, match=f"'say' is text; got {type(value).__name__}"):
        encode({**GOOD, "say": value})


@pytest.mark.parametrize("value", ["go home", np.str_("go home"), np.array("go home"), np.array(["go home"])])
def test_text_from_a_recording_is_text(encode, value):
    np.testing.assert_array_equal(encode({**GOOD, "say": value})["say"], [[2, 3, 0]])


def test_a_named_axis_has_any_length(tmp_path: Path):
    encode = encoder(tmp_path, TensorSpec("cloud", (1, "points", 3)))
    for points in (1, 7):
        assert encode({"cloud": np.zeros((points, 3), np.float32)})["cloud"].shape == (1, points, 3)
    with pytest.raises(DataError, match=r"takes \[1, 'points', 3\]"):
        encode({"cloud": np.zeros((7, 2), np.float32)})


def test_flags_stay_flags(tmp_path: Path):
    encode = encoder(tmp_path, TensorSpec("held", (1,), "bool"))
    assert encode({"held": True})["held"].dtype == np.bool_
    with pytest.raises(DataError, match="'held' is int64"):
        encode({"held": 1})


def test_a_normalised_input_has_the_dtype_that_the_graph_takes(tmp_path: Path):
    tensor = TensorSpec("state", (1, 2), "float16", normalisation="mean_std", statistics="stats.json#state")
    got = encoder(tmp_path, tensor)({"state": [3.0, 6.0]})["state"]
    assert got.dtype == np.float16
    np.testing.assert_array_equal(got, [[1.0, 1.0]])


def test_missing_statistics_are_seen_before_the_first_observation(tmp_path: Path):
    with pytest.raises(SpecError, match="statistics of 'state' are missing"):
        encoder(tmp_path, TensorSpec("state", (1, 2), normalisation="mean_std", statistics="absent.json#state"))


def test_a_prompt_has_the_normalised_state_of_its_observation_in_bins(tmp_path: Path):
    words = {word: index for index, word in enumerate(["lift", "-1", "0", "1", "2", "3"], 10)}
    (tmp_path / "tokenizer.json").write_text(json.dumps({"kind": "words", "pad": 0, "unknown": 1, "words": words}))
    low, high = [-0.3, 1, 5], [0.5, 1.7, 5]
    (tmp_path / "stats.json").write_text(json.dumps({"joints": {"q01": low, "q99": high}}))
    prompt = {"template": "{} {state}", "strip": True, "replace": {"\n": " "}, "state": {"input": "joints", "bins": 4}}
    spec = PolicySpec.from_dict({
        "inputs": [
            {"name": "task", "kind": "text", "tokenizer": "tokenizer.json", "max_tokens": 5, "prompt": prompt},
            {"name": "joints", "shape": [1, 3], "normalisation": "quantiles", "epsilon": 1e-8,
             "statistics": "stats.json#joints"},
        ],
        "outputs": [{"name": "y", "shape": [1, 1]}], "control_hz": 10,
    })  # fmt: skip
    encode = ObservationEncoder(spec, tmp_path)
    for joints, bins in ((low, [12, 12, 12]), (high, [15, 15, 12]), ([-9, 1.35, 5], [11, 14, 12])):
        encoded = encode({"task": " lift\n", "joints": np.array(joints, np.float32)})
        assert encoded["task"].tolist() == [[10, *bins, 0]]
        assert encode(encoded)["task"].tolist() == [[10, *bins, 0]]
