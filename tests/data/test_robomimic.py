"""What robomimic writes beside the arrays: filter keys, numbers of samples, the rate, instructions."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import _datasets as datasets
import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.cli import main
from vlatool.data._reader import NamedRecording, read_recording, reader_of
from vlatool.errors import DataError

h5py = pytest.importorskip("h5py", reason="it is read with h5py (extra data)")
ROWS = {number: np.flatnonzero(at == datasets.EPISODES) for at, number in enumerate((2, 9, 10))}


def spec(*names: str) -> PolicySpec:
    state = TensorSpec(name="robot0_eef_pos", shape=(1, datasets.STATE.shape[1]), unit="m")
    texts = [TensorSpec(name=each, kind="text", shape=(1, 8), dtype="int64", tokenizer="t.json", max_tokens=8)
             for each in names]  # fmt: skip
    action = TensorSpec(name="action", shape=(1, 2, datasets.ACTION.shape[1]), unit="m")
    return PolicySpec(inputs=(state, *texts), outputs=(action,), control_hz=float(datasets.HZ), chunk=2)


def changed(tmp_path: Path, change: Callable[[Any], None]) -> Path:
    """A file of robomimic, changed by a function of it."""
    path = datasets.robomimic(tmp_path / "demo.hdf5")
    with h5py.File(path, "a") as opened:
        change(opened)
    return path


def read(path: Path, key: str = "") -> Any:
    return read_recording(NamedRecording(path, {"mask": key} if key else {}), spec())


def test_a_filter_key_chooses_the_episodes(tmp_path):
    path = datasets.robomimic(tmp_path / "demo.hdf5")
    for key, numbers in {"": (2, 9, 10), "train": (2, 10), "valid": (9,)}.items():
        recording = read(path, key)
        rows = np.concatenate([ROWS[number] for number in numbers])
        np.testing.assert_array_equal(np.asarray(recording.inputs["robot0_eef_pos"]), datasets.STATE[rows])
        np.testing.assert_array_equal(np.asarray(recording.actions)[:, 0], datasets.ACTION[rows])


def test_rate_and_filter_keys_are_told(tmp_path, capsys):
    path = datasets.robomimic(tmp_path / "demo.hdf5")
    steps = reader_of(path).steps(path)
    assert steps.hz == datasets.HZ
    assert set(steps.columns) == {"actions", "states", "obs/agentview_image", "obs/robot0_eef_pos"}
    with pytest.raises(SystemExit) as ended:
        main(["data", "inspect", str(path)])
    assert ended.value.code == 0
    assert "filter keys train (2 episodes), valid (1 episode)" in " ".join(capsys.readouterr().out.split())


def test_states_are_empty_where_nothing_is_simulated(tmp_path):
    def empty(opened: Any) -> None:
        for demo in opened["data"].values():
            del demo["states"]
            demo.create_dataset("states", data=np.array([]))

    steps = reader_of(path := changed(tmp_path, empty)).steps(path)
    assert len(steps) == datasets.COUNT
    assert "states" not in steps.columns


def test_instructions_are_of_the_episode_else_of_the_file(tmp_path):
    def describe(opened: Any) -> None:
        opened["data"].attrs["problem_info"] = json.dumps({"language_instruction": ["lift", "the", "cube"]})
        opened["data/demo_9"].attrs["ep_meta"] = json.dumps({"lang": "open the drawer", "layout_id": 3})

    steps = reader_of(path := changed(tmp_path, describe)).steps(path)
    texts = steps.columns["instruction"]
    assert set(texts[ROWS[9]]) == {"open the drawer"}
    assert set(texts[ROWS[2]]) == set(texts[ROWS[10]]) == {"lift the cube"}
    assert read_recording(path, spec("task")).inputs["task"][0] == "lift the cube"


@pytest.mark.parametrize(
    "written", ["{", "[1]", "{}", '{"env_kwargs": []}', '{"env_kwargs": {"control_freq": "20"}}', "[" * 9999,
                '{"env_kwargs": {"control_freq": true}}', '{"env_kwargs": {"control_freq": NaN}}'],
)  # fmt: skip
def test_environments_that_name_no_rate_have_none(tmp_path, written):
    path = changed(tmp_path, lambda opened: opened["data"].attrs.__setitem__("env_args", written))
    assert reader_of(path).steps(path).hz == 0


def test_a_total_of_other_episodes_is_told(tmp_path):
    path = changed(tmp_path, lambda opened: opened["data"].attrs.__setitem__("total", 7))
    assert f"Its attribute total is 7, and it has {datasets.COUNT} steps." in reader_of(path).steps(path).notes


WRONG: dict[str, tuple[Callable[[Any], None], str, str]] = {
    "no such key": (lambda _: None, "test", "no filter key 'test'"),
    "an episode that is gone": (lambda opened: opened["data"].__delitem__("demo_9"), "valid", "names demo_9"),
    "samples": (lambda opened: opened["data/demo_9"].attrs.__setitem__("num_samples", 3), "", "num_samples is 3"),
    "several": (lambda opened: opened["data/demo_9"].attrs.__setitem__("num_samples", [1, 2]), "", "num_samples is"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_contradicts_itself_is_an_error(tmp_path, case):
    change, key, message = WRONG[case]
    with pytest.raises(DataError, match=message):
        read(changed(tmp_path, change), key)


def test_files_of_aloha_have_no_filter_keys(tmp_path):
    with pytest.raises(DataError, match="not a file of robomimic"):
        read_recording(NamedRecording(datasets.aloha(tmp_path / "aloha"), {"mask": "train"}), spec())
