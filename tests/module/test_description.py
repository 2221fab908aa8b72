from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from vlatool.bundle.bundle import LOCATION
from vlatool.bundle.program import single_graph
from vlatool.errors import DataError, SourceError, SpecError
from vlatool.module.description import carry_recordings, read_description, read_location, write_location

SPEC = {
    "inputs": [{"name": "x", "shape": [1, 2]}],
    "outputs": [{"name": "y", "shape": [1, 2]}],
    "control_hz": 10,
}
STEP = {"graph": "main", "feeds": {"x": "x"}, "gives": {"y": "y"}}


def write(folder: Path, data: Any = None, **changes: Any) -> Path:
    content = data if data is not None else {"name": "tiny", "spec": SPEC, **changes}
    (folder / "policy.yaml").write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return folder


def test_a_complete_description(policy_dir: Path):
    described = read_description(policy_dir)
    assert (described.name, described.version, described.license) == ("tiny", "1.2.0", "MIT")
    assert described.factory == "policy.py:make"
    assert described.arguments == {"layers": 1}
    assert described.environment["tasks"] == ["reach", "push"]
    assert described.parts["head"] == ["head"]
    assert described.program == single_graph(described.spec)
    assert [file.name for file in described.assets()] == ["statistics.json", "vocabulary.json"]
    assert described.calibration == policy_dir / "calibration.npz"
    assert described.evaluation == policy_dir / "evaluation.npz"


def test_file_and_directory_say_the_same(policy_dir: Path):
    assert read_description(policy_dir / "policy.yaml") == read_description(policy_dir)


def test_a_short_description_has_defaults(tmp_path: Path):
    described = read_description(write(tmp_path))
    assert (described.version, described.factory, described.arguments) == ("0.0.0", "", {})
    assert described.calibration is None
    assert described.assets() == []


def test_an_own_program_is_read(tmp_path: Path):
    described = read_description(write(tmp_path, program=[{**STEP, "graph": "head", "repeat": 2}]))
    assert described.program[0].repeat == 2


def test_recorded_data_may_have_another_name(tmp_path: Path):
    (tmp_path / "walks.npz").touch()
    assert read_description(write(tmp_path, calibration="walks.npz")).calibration == tmp_path / "walks.npz"


def test_a_function_to_train_with_is_in_the_folder(tmp_path: Path):
    (tmp_path / "train.py").touch()
    assert read_description(write(tmp_path, training="train.py:batches")).training == "train.py:batches"


@pytest.mark.parametrize("named", ["file", "folder"])
def test_no_description(tmp_path: Path, named):
    with pytest.raises(SourceError, match=r"No such file: .*policy.yaml") as caught:
        read_description(tmp_path / "policy.yaml" if named == "file" else tmp_path)
    assert "your-own-policy" in caught.value.fix


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("name: [", "is not valid YAML"),
        ("name: !!python/object/apply:os.getcwd []", "only plain values are read"),
        ("", "is empty; it must be a mapping"),
        ("chunk: 1" + 5000 * "0", "has a whole number of more than 4,300 digits"),
        ("- name", "must be a mapping; got list"),
        ({"spec": SPEC}, "has no 'name'"),
        ({"name": "tiny"}, "has no 'spec'"),
        ({"name": "tiny", "spec": SPEC, "sauce": "policy.py:make"}, "unknown key 'sauce'; did you mean 'source'"),
        (
            {"name": "tiny", "spec": SPEC, "calibration": "absent.npz"},
            "calibration data absent.npz, which does not exist",
        ),
        ({"name": "tiny", "spec": SPEC, "evaluation": "absent.npz"}, "evaluation data absent.npz"),
        ({"name": "tiny", "spec": SPEC, "training": "train.py:batches"}, "there is no file train.py"),
        ({"name": "tiny", "spec": SPEC, "training": "train.py"}, "as train.py:batches; got 'train.py'"),
        ({"name": "tiny", "spec": SPEC, "training": "train.py:a.b"}, "must be a function in a file of the folder"),
        ({"name": "tiny", "spec": SPEC, "training": "package:batches"}, "got 'package:batches'"),
        ({"name": "tiny", "spec": SPEC, "training": "../train.py:batches"}, "must be a function in a file"),
        ({"name": "tiny", "spec": SPEC, "training": "/train.py:batches"}, "must be a function in a file"),
        ({"name": "tiny", "spec": SPEC, "training": {"make": "train.py:batches"}}, "must be a function in a file"),
        ({"name": "tiny", "spec": SPEC, "training": None}, "got None"),
        ({"name": "tiny", "spec": SPEC, "source": "../policy.py:make"}, "'source' names a file outside the folder"),
        ({"name": "tiny", "spec": SPEC, "source": "a/../../policy.py:make"}, "'source' names a file outside the fold"),
        ({"name": "tiny", "spec": SPEC, "source": "/tmp/policy.py:make"}, "'source' names a file outside the folder"),
        (
            {"name": "tiny", "spec": SPEC, "environment": {"make": "../environment.py:make", "tasks": ["a"]}},
            "'environment' names a file outside the folder of the policy: ../environment.py:make",
        ),
        ({"name": "", "spec": SPEC}, "'name' must be text of 1 to 100 characters"),
        ({"name": 100 * "ab", "spec": SPEC}, "'name' must be text of 1 to 100 characters.*got 'abab.*200 characters"),
        ({"name": "a\x1b[2J", "spec": SPEC}, "'name' must be text of 1 to 100 characters without control characters"),
        ({"name": "a\u202eb", "spec": SPEC}, "'name' must be text .* without control characters"),
        ({"name": "tiny", "version": "1\n2", "spec": SPEC}, "'version' must be text .* without control characters"),
        (
            {"name": "tiny", "spec": {**SPEC, "outputs": [{"name": "y", "shape": [1, 3], "labels": ["l", "l", "f"]}]}},
            "the labels of 'y' name 'l' 2 times",
        ),
    ],
)
def test_a_description_that_is_wrong(tmp_path: Path, data, message):
    with pytest.raises(SourceError, match=message):
        read_description(write(tmp_path, data))


def test_a_recording_without_an_input_is_named_as_the_user_knows_it(policy_dir: Path, tmp_path: Path):
    described = read_description(policy_dir)
    with np.load(policy_dir / "evaluation.npz") as stored:
        arrays = {name: value for name, value in stored.items() if name != "proprio"}
    np.savez(policy_dir / "evaluation.npz", **arrays)
    with pytest.raises(DataError, match=rf"^{policy_dir}/evaluation.npz has no 'proprio'; .*known: ") as caught:
        carry_recordings(described, tmp_path / "out")
    assert caught.value.fix.startswith("record every input of the spec under its name")
    (policy_dir / "evaluation.npz").write_bytes(b"PK")
    with pytest.raises(DataError, match=rf"^{policy_dir}/evaluation.npz cannot be read: "):
        carry_recordings(described, tmp_path / "broken")
    data = bytearray((policy_dir / "calibration.npz").read_bytes())
    at = data.rindex(b"PK\x01\x02")  # the last entry of the directory: a version that nobody reads yet
    data[at + 6 : at + 8] = b"\xff\xff"
    (policy_dir / "evaluation.npz").write_bytes(data)
    with pytest.raises(DataError, match=rf"^{policy_dir}/evaluation.npz cannot be read: "):
        carry_recordings(described, tmp_path / "other")


@pytest.mark.parametrize("key", ["calibration", "evaluation"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_sample_that_is_not_finite_is_named_in_the_file_of_the_user(policy_dir: Path, tmp_path: Path, key, value):
    with np.load(policy_dir / f"{key}.npz") as stored:
        arrays = dict(stored)
    arrays["proprio"][[2, 4], 1] = value
    np.savez(policy_dir / f"{key}.npz", **arrays)
    message = rf"^'proprio' in {policy_dir}/{key}.npz is not finite in 2 of \d+ samples; the first is sample 2\.$"
    with pytest.raises(DataError, match=message.removesuffix("$")):
        carry_recordings(read_description(policy_dir), tmp_path / "out")


def test_text_that_is_no_utf8(tmp_path: Path):
    (tmp_path / "policy.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(SourceError, match="cannot be read"):
        read_description(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"spec": None},
        {"spec": {**SPEC, "control_hz": 0}},
        {"program": []},
        {"program": [{**STEP, "feeds": {"x": "z"}}]},
    ],
    ids=["no spec", "rate", "empty program", "unknown value"],
)
def test_an_impossible_spec_or_program(tmp_path: Path, changes):
    with pytest.raises(SpecError):
        read_description(write(tmp_path, **changes))


@pytest.mark.parametrize(
    "changes",
    [{"arguments": ["layers"]}, {"environment": "env.py:make"}, {"parts": "head"}],
    ids=lambda value: str(value),
)
def test_a_mapping_that_is_none_is_a_source_error_and_no_traceback(tmp_path: Path, changes):
    with pytest.raises(SourceError, match=next(iter(changes))):
        read_description(write(tmp_path, **changes))


def test_a_newer_schema_asks_for_an_upgrade(tmp_path: Path):
    with pytest.raises(SourceError, match="schema") as caught:
        read_description(write(tmp_path, schema=99))
    assert caught.value.fix == "upgrade vlatool"


def test_the_place_of_the_code_is_noted(tmp_path: Path):
    bundle, folder = tmp_path / "bundle", tmp_path / "policy"
    bundle.mkdir()
    folder.mkdir()
    write_location(bundle, folder)
    assert read_location(bundle) == folder
    folder.rmdir()
    with pytest.raises(SourceError, match="which is gone"):
        read_location(bundle)


@pytest.mark.parametrize("text", [None, "", "{}", "[]"])
def test_a_bundle_that_does_not_say_where_its_code_is(tmp_path: Path, text):
    if text is not None:
        (tmp_path / LOCATION).write_text(text)
    with pytest.raises(SourceError, match="does not say where the policy's code is"):
        read_location(tmp_path)


@pytest.mark.parametrize("key", ["calibration", "evaluation"])
def test_a_recording_may_have_other_names(tmp_path: Path, key: str):
    np.savez(tmp_path / "walk.npz", **{"observation.x": np.zeros((20, 2), np.float32)})
    entry = {"path": "walk.npz", "map": {"x": "observation.x"}}
    described = read_description(write(tmp_path, **{key: entry}))
    assert described.recordings() == {key: tmp_path / "walk.npz"}
    assert described.maps[key] == {"x": "observation.x"}
    (tmp_path / "out").mkdir()
    carry_recordings(described, tmp_path / "out")
    with np.load(tmp_path / f"out/data/{key}.npz") as arrays:
        assert arrays["x"].shape == (20, 2)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"path": "walk.npz", "maps": {}}, "'calibration' has the unknown key 'maps'; known: map, path"),
        ({"path": "walk.npz", "map": ["x"]}, "'map' of 'calibration' must name"),
        ({"path": "walk.npz", "map": {"x": 3}}, "'map' of 'calibration' must name"),
        ({"path": "absent.npz"}, "names the calibration data absent.npz, which does not exist"),
    ],
)
def test_a_wrong_entry_of_a_recording_is_refused(tmp_path: Path, entry: Any, message: str):
    (tmp_path / "walk.npz").touch()
    with pytest.raises(SourceError, match=message):
        read_description(write(tmp_path, calibration=entry))
