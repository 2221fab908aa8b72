import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import (
    npz,
    observations_for,
    random_observations,
    read_recording,
    recorded_observations,
    synthetic_observations,
)
from vlatool.data._random_observations import words_of
from vlatool.errors import DataError
from vlatool.files.rows import Rows
from vlatool.runtime.observation import ObservationEncoder

COUNT = 6
SPEC = PolicySpec(
    (
        TensorSpec("image", (1, 2, 2, 3), "uint8"),
        TensorSpec("state", (1, 2)),
        TensorSpec("say", (1, 4), "int64", kind="text", tokenizer="words.json", max_tokens=4),
    ),
    (TensorSpec("move", (1, 3, 2)),),
    10.0,
    3,
)
DISCRETE = PolicySpec(SPEC.inputs, (TensorSpec("logits", (1, 2), kind="discrete", labels=("left", "right")),), 5.0)


def arrays(count: int = COUNT, **changes: Any) -> dict[str, Any]:
    made: dict[str, Any] = {
        "image": np.arange(count * 12, dtype=np.uint8).reshape(count, 2, 2, 3),
        "state": np.arange(count * 2, dtype=np.float32).reshape(count, 2),
        "say": np.array([f"go {number}" for number in range(count)], dtype=str),
        **changes,
    }
    return {name: value for name, value in made.items() if value is not None}


def read(folder: Path, spec: PolicySpec = SPEC, **changes: Any):
    path = folder / "recording.npz"
    np.savez(path, **arrays(**changes))
    return read_recording(path, spec)


def refused(folder: Path, message: str, spec: PolicySpec = SPEC, **changes: Any) -> DataError:
    with pytest.raises(DataError, match=message) as caught:
        read(folder, spec, **changes)
    return caught.value


def test_observations_come_without_the_batch_axis_and_text_as_text(tmp_path: Path):
    recording = read(tmp_path)
    assert len(recording) == COUNT
    assert recording.actions is None
    assert recording.episodes is None
    observations = list(recording)
    assert len(observations) == COUNT
    assert [type(observations[2][name]) for name in ("image", "state", "say")] == [np.ndarray, np.ndarray, str]
    assert observations[2]["say"] == "go 2"
    np.testing.assert_array_equal(observations[2]["state"], [4, 5])


def test_a_stored_batch_axis_is_taken_away(tmp_path: Path):
    plain = arrays()
    recording = read(tmp_path, image=plain["image"][:, None], state=plain["state"][:, None])
    assert recording.observation(0)["image"].shape == (2, 2, 3)
    assert recording.observation(0)["state"].shape == (2,)


MOMENTS = PolicySpec(
    (TensorSpec("image", (1, 2, 2, 2, 3), "uint8", history=2), TensorSpec("state", (1, 3, 2), history=3)),
    SPEC.outputs,
    10.0,
    3,
)


def test_earlier_moments_come_from_the_episode(tmp_path: Path):
    recording = read(tmp_path, MOMENTS, episode=np.array([0, 0, 0, 0, 1, 1]))
    firsts = [row[:, 0].tolist() for row in (each["state"] for each in recording)]
    assert firsts == [[0, 0, 0], [0, 0, 2], [0, 2, 4], [2, 4, 6], [8, 8, 8], [8, 8, 10]]
    assert recording.observation(3)["image"].shape == (2, 2, 2, 3)
    np.testing.assert_array_equal(recording.observation(3)["image"][1], arrays()["image"][3])
    np.testing.assert_array_equal(recording.observation(4)["image"][0], arrays()["image"][4])


def test_earlier_moments_of_rows_on_the_disk_are_read(tmp_path: Path):
    image = np.zeros((COUNT, 1024, 1024, 3), np.uint8)
    image[:, 0, 0, 0] = range(COUNT)
    large = PolicySpec((TensorSpec("image", (1, 2, 1024, 1024, 3), "uint8", history=2),), SPEC.outputs, 10.0, 3)
    recording = read(tmp_path, large, image=image)
    assert isinstance(recording.inputs["image"], Rows)
    assert recording.subset(np.arange(COUNT) > 2).observation(0)["image"][:, 0, 0, 0].tolist() == [2, 3]


def test_a_selection_looks_back_beyond_itself(tmp_path: Path):
    half = read(tmp_path, MOMENTS, episode=np.array([0, 0, 0, 0, 1, 1])).subset(np.arange(COUNT) % 2 == 1)
    again = half.subset(np.array([False, True, True]))
    assert [each["state"][:, 0].tolist() for each in again] == [[2, 4, 6], [8, 8, 10]]


def test_a_sample_of_an_input_with_history_is_one_moment(tmp_path: Path):
    whole = np.zeros((COUNT, 3, 2), np.float32)
    refused(tmp_path, r"'state' .* shape \[6, 3, 2\]; wanted \[N, 2\]", MOMENTS, state=whole)


TURN = {"op": "rotation", "parts": [[0, 3]], "robot": "axis_angle", "network": "6d_rows"}


def test_what_is_converted_is_recorded_as_the_robot_has_it(tmp_path: Path):
    state, action = (
        TensorSpec.from_dict({"name": name, "shape": shape, "convert": [TURN]})
        for name, shape in (("state", [1, 6]), ("action", [1, 2, 7]))
    )
    spec = PolicySpec((state,), (action,), 10.0, chunk=2)
    given = {"state": np.ones((COUNT, 3), np.float32), "action": np.ones((COUNT, 2, 4), np.float32)}
    assert read(tmp_path, spec, **given).observation(0)["state"].shape == (3,)
    refused(tmp_path, r"'state' in .* \[6, 6\]; wanted \[N, 3\]", spec, **given | {"state": np.ones((COUNT, 6))})
    refused(tmp_path, "has 7 elements; the policy gives 4", spec, **given | {"action": np.ones((COUNT, 2, 7))})
    drawn = random_observations(spec, 3)
    assert [each["state"].shape for each in drawn] == [(3,)] * 3


def test_frames_of_any_size_may_have_a_history(tmp_path: Path):
    image = {"layout": "hwc", "steps": [{"op": "resize", "size": [4, 6]}]}
    frames = TensorSpec.from_dict(
        {"name": "image", "shape": [1, 2, 4, 6, 3], "dtype": "uint8", "history": 2, "image": image}
    )
    spec = PolicySpec((frames,), (TensorSpec("action", (1, 2)),), 10.0)
    recording = read(tmp_path, spec)
    assert recording.observation(1)["image"].shape == (2, 2, 2, 3)
    encode = ObservationEncoder(spec, tmp_path)
    assert encode(recording.observation(1))["image"].shape == (1, 2, 4, 6, 3)
    assert [encode(each)["image"].shape for each in random_observations(spec, 3)] == [(1, 2, 4, 6, 3)] * 3


def test_text_with_a_batch_axis_is_the_text_itself(tmp_path: Path):
    assert read(tmp_path, say=arrays()["say"][:, None]).observation(2)["say"] == "go 2"


def test_samples_are_spread_over_the_recording(tmp_path: Path):
    recording = read(tmp_path, count=100)
    assert recording.spread(5) == [0, 24, 49, 74, 99]
    assert recording.spread(1) == [0]
    assert recording.spread(100) == recording.spread(1000) == list(range(100))
    assert len(recording.spread(99)) == 99


@pytest.mark.parametrize("name", ["action", "move"])
def test_actions_are_found_by_either_name(tmp_path: Path, name):
    actions = np.arange(COUNT * 6, dtype=np.float32).reshape(COUNT, 3, 2)
    recording = read(tmp_path, **{name: actions}, episode=np.arange(COUNT))
    np.testing.assert_array_equal(recording.actions, actions)
    np.testing.assert_array_equal(recording.episodes, np.arange(COUNT))


def test_single_actions_become_chunks_of_one(tmp_path: Path):
    assert read(tmp_path, action=np.zeros((COUNT, 2), np.float32)).actions.shape == (COUNT, 1, 2)


@pytest.mark.parametrize(
    ("shape", "steps"), [((COUNT, 3, 2), 3), ((COUNT, 2, 2), 2), ((COUNT, 1, 2), 1), ((COUNT, 2), 1)]
)
def test_a_chunk_that_is_recorded_in_part_is_told(tmp_path: Path, shape, steps):
    recording = read(tmp_path, action=np.zeros(shape, np.float32))
    assert recording.actions.shape == (COUNT, steps, 2)
    if steps == 3:
        assert recording.unjudged_steps == ()
    else:
        (told,) = recording.unjudged_steps
        some = "the first one alone is" if steps == 1 else "the first 2 alone are"
        assert told.startswith(f"recording.npz records {steps} of the 3 actions of each chunk: {some} held against")
    assert read(tmp_path).unjudged_steps == (), "nothing is held against an expert where there is none"


@pytest.mark.parametrize(
    ("spec", "shape"), [(SPEC, (COUNT, 4, 2)), (SPEC, (COUNT, 0, 2)), (SPEC, (COUNT, 3, 3, 2)), (DISCRETE, (COUNT, 2))]
)
def test_more_steps_than_the_chunk_and_none_are_refused(tmp_path: Path, spec, shape):
    kind = np.int64 if spec is DISCRETE else np.float32
    steps = int(np.prod(shape[1:-1])) if spec is SPEC else shape[1]
    message = f"has {steps} steps in each sample; allowed: 1 to {spec.chunk}, the policy's chunk"
    assert "as many as the policy gives" in refused(tmp_path, message, spec, action=np.zeros(shape, kind)).fix


@pytest.mark.parametrize("values", [["go"] * COUNT, [True] * COUNT, [1j] * COUNT])
def test_actions_that_are_no_numbers_are_refused(tmp_path: Path, values):
    actions = np.repeat(np.array(values)[:, None], 2, axis=1)
    refused(tmp_path, "expert's action .* wanted numbers in physical units", action=actions)


def test_discrete_actions_are_indices(tmp_path: Path):
    recording = read(tmp_path, DISCRETE, action=np.arange(COUNT) % 2)
    assert recording.actions.ravel().tolist() == [0, 1, 0, 1, 0, 1]


@pytest.mark.parametrize("actions", [np.full(COUNT, 2), np.full(COUNT, -1), np.zeros(COUNT, np.float32)])
def test_discrete_actions_outside_the_labels_are_refused(tmp_path: Path, actions):
    refused(tmp_path, "must be indices from 0 to 1", DISCRETE, action=actions)


@pytest.mark.parametrize("wrong", [2, 9, -1])
def test_the_first_wrong_label_and_its_sample_are_named(tmp_path: Path, wrong: int):
    actions = np.arange(COUNT) % 2
    actions[[3, 5]] = wrong
    message = rf"indices from 0 to 1; got {wrong} in sample 3 \(and in 2 of 6 samples such a value\)"
    refused(tmp_path, message, DISCRETE, action=actions)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": None, "sate": np.zeros((COUNT, 2))}, "has no 'state'; did you mean 'sate'"),
        ({"say": np.zeros(COUNT)}, "'say' in .* is float64; a text input needs unicode strings"),
        ({"say": np.array([b"go"] * COUNT)}, "'say' in .* is .S2; a text input needs unicode strings"),
        ({"image": np.zeros((COUNT, 3, 2, 2), np.uint8)}, r"'image' .* shape \[6, 3, 2, 2\]; wanted \[N, 2, 2, 3\]"),
        ({"state": np.zeros(COUNT)}, r"'state' .* shape \[6\]; wanted \[N, 2\]"),
        ({"state": np.float32(1)}, r"'state' .* shape \[\]"),
        ({"image": np.zeros((COUNT, 2, 2, 3), np.float32)}, "'image' .* is float32; the policy takes uint8"),
        ({"state": np.zeros((5, 2))}, "different numbers of samples: .*'state': 5"),
        ({"action": np.zeros((4, 3, 2))}, "different numbers of samples: .*'action': 4"),
        ({"episode": np.zeros(7)}, "different numbers of samples: .*'episode': 7"),
        ({"count": 0}, "holds no samples"),
        ({"action": np.zeros((COUNT, 3, 4))}, "expert's action .* has 4 elements; the policy gives 2"),
    ],
)
def test_what_does_not_fit_the_spec_is_named(tmp_path: Path, changes, message):
    refused(tmp_path, message, **changes)


@pytest.mark.parametrize("name", ["action", "episode", "say"])
def test_an_array_without_samples_axis_is_refused_without_a_traceback(tmp_path: Path, name):
    refused(tmp_path, name, **{name: np.array("go") if name == "say" else np.float32(1)})


def test_what_is_not_finite_is_counted_and_the_first_sample_named(tmp_path: Path):
    state = arrays()["state"]
    state[2, 1], state[4] = np.nan, np.inf
    error = refused(tmp_path, "'state' .* not finite in 2 of 6 samples; the first is sample 2", state=state)
    assert "remove those samples" in error.fix
    actions = np.zeros((COUNT, 3, 2))
    actions[5] = np.nan
    refused(tmp_path, "expert's action .* in 1 of 6 samples; the first is sample 5", action=actions)


def test_named_axes_have_any_length(tmp_path: Path):
    spec = PolicySpec((TensorSpec("cloud", (1, "points", 3)),), SPEC.outputs, 10.0)
    path = tmp_path / "a.npz"
    np.savez(path, cloud=np.zeros((4, 9, 3), np.float32))
    assert read_recording(path, spec).observation(0)["cloud"].shape == (9, 3)
    np.savez(path, cloud=np.zeros((4, 9, 2), np.float32))
    with pytest.raises(DataError, match=r"wanted \[N, points, 3\]"):
        read_recording(path, spec)


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(DataError, match=r"Data file .* not found"):
        read_recording(tmp_path / "absent.npz", SPEC)


def test_an_unknown_format_gets_the_nearest_one(tmp_path: Path):
    (tmp_path / "recording.npy").touch()
    with pytest.raises(DataError, match="unknown format; did you mean 'npz'"):
        read_recording(tmp_path / "recording.npy", SPEC)


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04nonsense"], ids=["empty", "nonsense", "half zip"])
def test_a_corrupt_file(tmp_path: Path, content):
    path = tmp_path / "recording.npz"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"recording.npz cannot be read") as caught:
        read_recording(path, SPEC)
    assert "np.savez" in caught.value.fix


def test_a_truncated_archive(tmp_path: Path):
    path = tmp_path / "recording.npz"
    np.savez(path, **arrays())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DataError, match="cannot be read"):
        read_recording(path, SPEC)


def test_a_damaged_member_of_a_compressed_archive(tmp_path: Path):
    path = tmp_path / "recording.npz"
    np.savez_compressed(path, **arrays())
    with zipfile.ZipFile(path) as archive:
        first = archive.infolist()[0]
        start = first.header_offset + 30 + len(first.filename)
    damaged = bytearray(path.read_bytes())
    damaged[start + 20 : start + 60] = b"\xff" * 40
    path.write_bytes(damaged)
    with pytest.raises(DataError, match="cannot be read"):
        read_recording(path, SPEC)


def test_pickled_objects_are_refused(tmp_path: Path):
    path = tmp_path / "recording.npz"
    np.savez(path, **arrays(state=np.array([{"x": 1}] * COUNT, dtype=object)))
    with pytest.raises(DataError, match="pickled objects, which are refused"):
        read_recording(path, SPEC)


def test_a_single_array_is_no_archive(tmp_path: Path):
    path = tmp_path / "recording.npz"
    with path.open("wb") as stream:
        np.save(stream, arrays()["state"])
    with pytest.raises(DataError, match="is one array, not an archive"):
        read_recording(path, SPEC)


def test_a_directory_is_no_recording(tmp_path: Path):
    (tmp_path / "recording.npz").mkdir()
    with pytest.raises(DataError, match="cannot be read"):
        read_recording(tmp_path / "recording.npz", SPEC)


def test_synthetic_observations_fit_the_spec_and_repeat(tmp_path: Path):
    spec = PolicySpec(
        (
            *SPEC.inputs,
            TensorSpec("cloud", (1, "points", 3), "float16"),
            TensorSpec("held", (1, 1), "bool"),
            TensorSpec("ids", (1, 5), "int32"),
        ),
        SPEC.outputs,
        10.0,
    )
    bundle = seal(tmp_path, Manifest("bare", "1", spec))
    first, again = synthetic_observations(bundle, 3), synthetic_observations(bundle, 3)
    assert len(first) == 3
    for one, other in zip(first, again, strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])
    assert first[0]["say"] == ""
    assert {name: (first[0][name].shape, str(first[0][name].dtype)) for name in ("image", "cloud", "held", "ids")} == {
        "image": ((2, 2, 3), "uint8"),
        "cloud": ((1, 3), "float16"),
        "held": ((1,), "bool"),
        "ids": ((5,), "int32"),
    }
    assert not np.array_equal(first[0]["image"], first[1]["image"])
    assert not np.array_equal(first[0]["image"], synthetic_observations(bundle, 1, seed=1)[0]["image"])


def test_a_bundle_without_recording_gives_synthetic_observations(tmp_path: Path):
    bundle = seal(tmp_path, Manifest("bare", "1", SPEC))
    assert recorded_observations(bundle, 3) == []
    assert len(observations_for(bundle, 3)) == 3
    assert observations_for(bundle, 3)[0]["say"] == ""


def test_synthetic_instructions_are_words_of_the_vocabulary_and_never_empty(float_bundle: Bundle):
    text = next(tensor for tensor in float_bundle.manifest.spec.inputs if tensor.kind == "text")
    known = words_of(float_bundle.path / "assets" / text.tokenizer)
    said = [item[text.name] for item in synthetic_observations(float_bundle, 16)]
    assert all(sentence and {*sentence.split()} <= {*known} for sentence in said)
    assert len({*said}) > 8
    assert max(len(sentence.split()) for sentence in said) <= text.max_tokens


def test_the_bundles_own_recording_comes_before_synthetic_observations(tmp_path: Path):
    (tmp_path / "data").mkdir()
    np.savez(tmp_path / "data/calibration.npz", **arrays())
    bundle: Bundle = seal(tmp_path, Manifest("with data", "1", SPEC))
    assert [item["say"] for item in observations_for(bundle, 3)] == ["go 0", "go 2", "go 5"]


def test_a_named_recording_comes_before_the_bundles_own(tmp_path: Path, float_bundle):
    own = recorded_observations(float_bundle, 2)
    other = recorded_observations(float_bundle, 2, float_bundle.path / "data/evaluation.npz")
    assert not np.array_equal(own[0]["image"], other[0]["image"])


@pytest.mark.parametrize("packed", ["recording.npz", "calibration.npz"])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, packed: str):
    path = tmp_path / packed
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (9000000000,), }"
    header = header.ljust(128 - 10 - 1) + b"\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("state.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    content = bytearray(path.read_bytes())
    at = content.rfind(b"PK\1\2") + 24
    content[at : at + 4] = (0xFFFFFFF0).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"MB are free|cannot be read|recording_bytes"):
        read_recording(path, SPEC)


def test_a_recording_larger_than_the_limit_says_how_to_raise_it(tmp_path: Path, monkeypatch):
    path = tmp_path / "recording.npz"
    np.savez_compressed(path, **arrays(), more=np.zeros(1 << 20))
    monkeypatch.setenv("VLATOOL_LIMITS", "recording_bytes=1e6")
    with pytest.raises(DataError, match="the limit 'recording_bytes' allows 1000000") as caught:
        read_recording(path, SPEC)
    monkeypatch.setenv("VLATOOL_LIMITS", caught.value.fix.partition("VLATOOL_LIMITS=")[2])
    read_recording(path, SPEC)


def test_a_recording_larger_than_the_memory_is_refused(tmp_path: Path, monkeypatch):
    path = tmp_path / "recording.npz"
    np.savez_compressed(path, **arrays(), more=np.zeros(1 << 20))
    monkeypatch.setattr(npz, "memory", lambda: {"memory_available_mb": 4000.0, "memory_limit_mb": 5.0})
    with pytest.raises(DataError, match="takes 8 MB of memory, unpacked; 5 MB are free"):
        read_recording(path, SPEC)
