from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.errors import RecipeError
from vlatool.gate.claims.latency import Latency
from vlatool.gate.config import Gate, read_gate


def written(folder: Path, text: str) -> Path:
    path = folder / "gate.yaml"
    path.write_text(text)
    return path


def test_the_defaults_claim_everything_but_a_deadline(tmp_path: Path) -> None:
    gate = read_gate(written(tmp_path, "{}"))
    assert gate == Gate()
    assert gate.latency == Latency()
    assert gate.latency.margin == 0.05
    assert gate.latency.interim_analyses == (10, 20, 40)
    assert gate.accuracy
    assert gate.memory
    assert gate.size
    assert gate.deadline is None


def test_a_gate_is_read_as_it_was_written(tmp_path: Path) -> None:
    text = "{latency: {margin: 0.02, interim_analyses: [12]}, size: null, deadline: {ms: 20}}"
    first = read_gate(written(tmp_path, text))
    assert read_gate(written(tmp_path, first.to_yaml())) == first
    assert first.size is None
    assert first.deadline
    assert (first.deadline.ms, first.deadline.percent) == (20, 99)


def test_a_file_of_an_older_version_calls_interim_analyses_looks(tmp_path: Path) -> None:
    gate = read_gate(written(tmp_path, "{latency: {looks: [12, 24]}}"))
    assert gate.latency.interim_analyses == (12, 24)
    assert "looks" not in gate.to_yaml()


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    text = "{baseline: models/base, accuracy: {data: ../d.npz, policy: /abs}}"
    gate = read_gate(written(tmp_path, text))
    assert gate.baseline == tmp_path / "models/base"
    assert gate.accuracy
    assert gate.accuracy.data == tmp_path / "../d.npz"
    assert gate.accuracy.policy == Path("/abs")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("- 1", "must be a mapping; got list"),
        ("{latency: {margin: -1}}", "latency.margin: Input should be greater than or equal to 0"),
        ("{latency: {interim_analyses: [3]}}", "interim_analyses must ascend and begin at 8 or later"),
        ("{latency: {interim_analyses: [5, 20, 40]}}", "interim_analyses must ascend and begin at 10 or later"),
        ("{latency: {interim_analyses: [20, 10]}}", "interim_analyses must ascend"),
        ("{latency: {interim_analyses: []}}", "interim_analyses must ascend"),
        ("{latency: {also_threads: [0]}}", "also_threads.0: Input should be greater than or equal to 1"),
        ("{answers: {follows: 2}}", "answers.follows: Input should be less than or equal to 1"),
        ("{answers: {observations: 3}}", "answers.observations: Input should be greater than or equal to 24"),
        ("{latency: {sped: 3}}", "latency.sped: is not a known key; known: also_threads, engine, interim_analyses"),
        ("{latency: {thread: 3}}", "latency.thread: is not a known key; did you mean 'threads'? known: also_threads"),
        ("{accuracy: {max-drop: {a: 1}}}", "accuracy.max-drop: is not a known key; did you mean 'max_drop'? kno"),
        ("{memroy: {margin: 1}}", "memroy: is not a known key; did you mean 'memory'? known: accept, accuracy"),
        ("{memory_margin: 1}", "memory_margin: is not a known key; did you mean 'memory'? known: accept, accuracy"),
        ("{schemas: 1}", "schemas: is not a known key; did you mean 'schema'? known: accept"),
        ("{worst: 1}", "worst: is not a known key; did you mean 'worst_task'? known: accept"),
        ("{deadline: {ms: 0}}", "deadline.ms: Input should be greater than 0"),
        ("{deadline: {ms: 5, percent: 98}}", "percent must be one of 50, 90, 95, 99, 99.9"),
        ("{deadline: {}}", "deadline.ms: Field required"),
        ("{accuracy: {max_drop: 2}}", "accuracy.max_drop: Input should be less than or equal to 1 (got 2)"),
        ("{latency: null, accuracy: null, answers: null, memory: null, size: null}", "every claim is null"),
        ("{schema: 2}", "schema: Input should be less than or equal to 1"),
        ("{latency: {margin: fast}}", "latency.margin: Input should be a valid number"),
        ("{latency: {margin: yes}}", "latency.margin: Input should be a number, not a truth value (got True)"),
        ("{a: [", "is not valid YAML"),
        ("baseline: 2024-02-30", "is not valid YAML: day is out of range"),
    ],
)
def test_what_is_impossible_is_named(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(RecipeError) as caught:
        read_gate(written(tmp_path, text))
    assert says in caught.value.message
    assert "gate.yaml" in caught.value.message


def test_a_percentage_is_told_how_a_share_is_written(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"max_drop: .* \(got '1%'\)") as caught:
        read_gate(written(tmp_path, "{accuracy: {max_drop: 1%}}"))
    assert "0.05 is 5 %" in caught.value.fix
    with pytest.raises(RecipeError) as caught:
        read_gate(written(tmp_path, "{accuracy: {max_drop: 2}}"))
    assert caught.value.fix == "docs/reference/gate.md says what each key takes"


def test_a_missing_gate_says_how_to_write_one(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"There is no gate") as caught:
        read_gate(tmp_path / "gate.yaml")
    assert caught.value.fix == "write one: vlatool gate init"
    with pytest.raises(RecipeError, match=r"cannot be read"):
        read_gate(tmp_path)
