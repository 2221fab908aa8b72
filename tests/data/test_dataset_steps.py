"""Datasets of one step a row: names, parts, windows at the end of an episode, samples, and what a bundle carries."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import StepReader, Steps, read_recording, sampled_rows
from vlatool.data._lazy_rows import LazyRows, text_rows
from vlatool.data._sampling import rows_to_carry, sampled_episodes, save_recording
from vlatool.data._step_reader import recording_of
from vlatool.errors import DataError

LENGTHS = (5, 2, 7)
COUNT = sum(LENGTHS)
SPEC = PolicySpec(
    (
        TensorSpec("image", (1, 4, 6, 3), "uint8"),
        TensorSpec("state", (1, 2)),
        TensorSpec("say", (1, 4), "int64", kind="text", tokenizer="words.json", max_tokens=4),
    ),
    (TensorSpec("action", (1, 3, 2)),),
    10.0,
    3,
)


def pictures(fetched: list[Any] | None = None, **changes: Any) -> LazyRows:
    def fetch(indices: Any) -> Any:
        if fetched is not None:
            fetched.extend(indices.tolist())
        return np.broadcast_to(indices[:, None, None, None], (len(indices), 4, 6, 3)).astype(np.uint8)

    return LazyRows(fetch, changes.get("shape", (COUNT, 4, 6, 3)), np.dtype(np.uint8), "the camera")


def steps(**columns: Any) -> Steps:
    episodes = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    own = {
        "observation.images.image": pictures(),
        "observation.state": np.arange(COUNT * 3, dtype=np.float32).reshape(COUNT, 3),
        "observation.gripper": np.arange(COUNT, dtype=np.float64),
        "task": text_rows(["pick", "place"], episodes % 2, "task"),
        "act": np.arange(COUNT * 2, dtype=np.float32).reshape(COUNT, 2),
        **columns,
    }
    own = {name: values for name, values in own.items() if values is not None}
    return Steps(Path("data"), own, episodes, np.arange(COUNT) / 10, "act", 10.0, episodes % 2)


def recording(names: dict[str, str] | None = None, spec: PolicySpec = SPEC, **columns: Any):
    return recording_of(steps(**columns), spec, {"state": "observation.state[0:2]", **(names or {})})


def test_inputs_are_found_by_the_last_part_of_a_name_and_the_instruction_as_the_only_text():
    observation = recording().observation(6)
    assert observation["image"].tolist() == np.full((4, 6, 3), 6).tolist()
    assert observation["say"] == "place"
    assert observation["state"].tolist() == [18, 19]


@pytest.mark.parametrize(
    ("named", "wanted"),
    [
        ("observation.state[1:3]", [19, 20]),
        ("observation.state[:2]", [18, 19]),
        ("observation.state[1:]", [19, 20]),
        ("observation.state[2]+observation.gripper", [20, 6]),
        ("observation.gripper + observation.state[0]", [6, 18]),
    ],
)
def test_a_vector_is_a_part_of_a_column_or_several(named, wanted):
    assert recording({"state": named}).observation(6)["state"].tolist() == wanted


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"state": "observation.stat"}, "data has no 'observation.stat'; did you mean 'observation.state'"),
        ({"state": "observation.state[3:5]"}, "takes no element of 'observation.state' in data, which has 3"),
        ({"state": "observation.images.image[0:2]"}, "is taken of 'observation.images.image' in data, which is uint8"),
        ({"state": "task[0]"}, "is taken of 'task' in data"),
        ({"stat": "observation.state"}, "'stat'; did you mean 'state'"),
        ({"state": "observation.state"}, r"has the shape \[14, 3\]; wanted \[N, 2\]"),
        ({"action": "observation.state"}, "has 3 elements; the policy gives 2"),
    ],
)
def test_names_that_do_not_fit_are_refused(names, message):
    with pytest.raises(DataError, match=message):
        recording(names)


def test_a_name_that_may_be_two_columns_is_not_guessed():
    with pytest.raises(DataError, match=r"has several for .image.; did you mean .front\.image") as caught:
        recording(**{"front.image": pictures()})
    assert "--map image=NAME" in caught.value.fix
    assert recording({"image": "front.image"}, **{"front.image": pictures()}).observation(1)["image"].max() == 1
    with pytest.raises(DataError, match="has no 'image'"):
        recording(**{"observation.images.image": None})


def test_nothing_is_judged_by_an_action_that_nobody_recorded():
    whole = recording()
    assert whole.actions.shape == (COUNT, 3, 2)
    assert whole.actions[3].tolist() == [[6, 7], [8, 9], [8, 9]]
    assert whole.padded.tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0, 0, 1, 1]
    judged = whole.with_whole_chunks()
    assert judged.indices.tolist() == [0, 1, 2, 7, 8, 9, 10, 11]
    assert judged.actions[3].tolist() == [[14, 15], [16, 17], [18, 19]]
    (sentence,) = judged.unjudged_steps
    assert sentence.startswith("6 of 14 observations of data are not judged: their episode ends before")
    assert judged.with_whole_chunks() is judged


def test_a_chunk_beyond_every_episode_is_judged_as_far_as_an_episode_goes():
    judged = recording(spec=replace(SPEC, outputs=(TensorSpec("action", (1, 50, 2)),), chunk=50)).with_whole_chunks()
    assert (judged.actions.shape, judged.indices.tolist()) == ((1, 7, 2), [7])
    assert judged.unjudged_steps[0].startswith("data records 7 of the 50 actions")


def test_without_actions_there_is_nothing_to_judge():
    whole = recording_of(replace(steps(), action=""), SPEC, {"state": "observation.state[0:2]"})
    assert whole.actions is None
    assert whole.with_whole_chunks() is whole


def test_pictures_are_decoded_when_they_are_asked_for():
    fetched: list[int] = []
    whole = recording(**{"observation.images.image": pictures(fetched)})
    subset = whole.subset(np.arange(COUNT) % 2 == 1)
    assert fetched == []
    assert subset.observation(2)["image"].max() == 5
    assert whole.inputs["image"][[3, 1]].max(axis=(1, 2, 3)).tolist() == [3, 1]
    assert fetched == [5, 3, 1]


def test_a_row_that_is_not_finite_or_of_another_shape_is_named_when_it_is_read():
    spec = PolicySpec((TensorSpec("depth", (1, 2, 2)),), SPEC.outputs, 10.0)

    def fetch(indices: Any) -> Any:
        values = np.zeros((len(indices), 2, 2 + (4 in indices)))
        values[indices == 3] = 1e39
        return values

    depth = LazyRows(fetch, (COUNT, 2, 2), np.dtype(np.float64), "the depth")
    read = recording_of(steps(depth=depth), spec, {}).observation
    assert read(2)["depth"].shape == (2, 2)
    for row, message in ((3, "not finite in float32 in sample 3"), (4, r"shape \[2, 3\] in sample 4; wanted \[2, 2\]")):
        with pytest.raises(DataError, match=message):
            read(row)


def test_columns_of_other_lengths_and_none_at_all_are_refused():
    with pytest.raises(DataError, match=r"different numbers of samples: \{.x.: 3\}; its episodes have 14 steps"):
        steps(x=np.zeros(3))
    with pytest.raises(DataError, match="holds no samples"):
        Steps(Path("a"), {}, np.zeros(0, np.int64))


def test_more_steps_than_the_limit_are_refused(monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "recorded_steps=9")
    with pytest.raises(DataError, match="data has 14 steps; the limit 'recorded_steps' allows 9"):
        steps()


def test_samples_are_spread_over_tasks_episodes_and_phases():
    lengths = np.array([100] * 9 + [10])
    episodes = np.repeat(np.arange(10), lengths)
    tasks = (episodes == 9).astype(np.int64)
    rows = sampled_rows(episodes, 20, tasks)
    assert len(rows) == len({*rows.tolist()}) == 20
    assert np.count_nonzero(tasks[rows]) == 10, "each task as often as the other"
    assert {*episodes[rows].tolist()} == {*range(10)}
    phases = (rows - np.concatenate([[0], np.cumsum(lengths)])[episodes[rows]]) / lengths[episodes[rows]]
    assert np.histogram(phases, 4, (0, 1))[0].min() >= 3
    for count in (1, 7, 909, 910, 5000):
        assert len({*sampled_rows(episodes, count, tasks).tolist()}) == min(count, 910)


def test_of_a_policy_that_keeps_values_whole_episodes_are_sampled():
    episodes = np.repeat(np.arange(50), 10)
    rows = sampled_episodes(episodes, 75)
    assert np.unique(episodes[rows], return_counts=True)[1].tolist() == [10] * 7
    assert len(sampled_episodes(episodes, 1)) == 20, "two, so that one can be held out"
    assert len(rows_to_carry(recording(), keeps=True)) == COUNT


def test_a_sample_is_read_again_as_it_was(tmp_path: Path):
    chosen = np.zeros(COUNT, np.bool_)
    chosen[[0, 3, 9]] = True
    part = recording().subset(chosen)
    save_recording(part, tmp_path / "part.npz")
    again = read_recording(tmp_path / "part.npz", SPEC)
    assert again.padded.tolist() == part.padded.tolist() == [False, True, False]
    assert again.episodes.tolist() == [0, 0, 2]
    for row in range(3):
        for name, value in part.observation(row).items():
            np.testing.assert_array_equal(again.observation(row)[name], value)
        np.testing.assert_array_equal(again.actions[row], part.actions[row])


def test_padding_is_truth_values(tmp_path: Path):
    save_recording(recording(), tmp_path / "part.npz")
    with np.load(tmp_path / "part.npz") as arrays:
        np.savez(tmp_path / "wrong.npz", **{**arrays, "action_is_pad": np.zeros((COUNT, 3))})
    with pytest.raises(DataError, match=r"'action_is_pad' in .* is float64; wanted truth values"):
        read_recording(tmp_path / "wrong.npz", SPEC)


def test_a_reader_of_steps_says_what_it_must_define():
    with pytest.raises(NotImplementedError):
        StepReader().open(Path("a"), SPEC, {})
