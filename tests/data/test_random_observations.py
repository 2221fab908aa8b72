from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import Drawer, read_drawn, read_recording, save_drawn
from vlatool.data._random_observations import EXTREME, words_of
from vlatool.errors import DataError

VOCABULARY = {"go", "to", "the", "red", "blue", "ball", "box"}


@pytest.fixture
def recording(float_bundle: Bundle):
    return read_recording(float_bundle.path / "data/evaluation.npz", float_bundle.manifest.spec)


def draw(drawer: Drawer, count: int = 80, seed: int = 0):
    return drawer.draw(count, np.random.default_rng(seed))


def test_kinds_are_mixed_where_there_is_a_recording(float_bundle: Bundle, recording) -> None:
    kinds = [each.kind for each in draw(Drawer(float_bundle, [recording]))]
    assert {kind: kinds.count(kind) for kind in kinds} == {"recorded": 40, "other": 20, "drawn": 20}
    assert {each.kind for each in draw(Drawer(float_bundle))} == {"drawn"}


def test_the_same_seed_draws_the_same_and_another_one_others(float_bundle: Bundle, recording) -> None:
    drawer = Drawer(float_bundle, [recording])
    one, same, other = ([each.observation["proprio"].tolist() for each in draw(drawer, 20, seed)] for seed in (1, 1, 2))
    assert one == same != other


def test_text_is_of_the_vocabulary_in_several_lengths(float_bundle: Bundle) -> None:
    texts = [each.observation["instruction"] for each in draw(Drawer(float_bundle), 200)]
    assert {word for text in texts for word in text.split()} == VOCABULARY
    assert {len(text.split()) for text in texts} == {0, 1, 2, 3}


def test_another_instruction_comes_with_a_recorded_image(float_bundle: Bundle, recording) -> None:
    images = {image.tobytes() for image in recording.inputs["image"]}
    others = [each.observation for each in draw(Drawer(float_bundle, [recording])) if each.kind == "other"]
    assert all(each["image"].tobytes() in images for each in others)
    assert {each["instruction"] for each in others} - set(recording.inputs["instruction"].tolist())


def test_images_have_structure(float_bundle: Bundle) -> None:
    images = [each.observation["image"] for each in draw(Drawer(float_bundle), 200)]
    assert all(image.shape == (8, 8, 3) and image.dtype == np.uint8 for image in images)
    spans = [int(np.ptp(image)) for image in images]
    assert 0 in spans, "of one colour"
    assert any(np.isin(image, (0, 255)).all() and np.ptp(image) == 255 for image in images), "black and white"
    smooth = [np.abs(np.diff(image.astype(int), axis=0)).max() for image in images if np.ptp(image) > 50]
    assert min(smooth) < 40, "gradients"


def test_states_reach_the_extremes_of_the_statistics_and_are_finite(float_bundle: Bundle) -> None:
    states = np.stack([each.observation["proprio"] for each in draw(Drawer(float_bundle), 200)])
    normalised = (states - [0.1, -0.2, 0.5]) / [0.5, 0.25, 2.0]
    assert states.dtype == np.float32
    assert np.abs(normalised).max() == pytest.approx(EXTREME, rel=1e-3)


def test_whole_numbers_keep_to_what_was_recorded(tmp_path: Path) -> None:
    spec = PolicySpec(
        (TensorSpec("ids", (1, 5), "int64"), TensorSpec("held", (1, 2), "bool"), TensorSpec("rgb", (1, 3, "n"))),
        (TensorSpec("action", (1, 2)),),
        10.0,
    )
    bundle = Bundle(tmp_path, Manifest("x", "1", spec))
    np.savez(
        tmp_path / "r.npz",
        ids=np.tile([3, 4, 5, 3, 3], (6, 1)),
        held=np.zeros((6, 2), bool),
        rgb=np.ones((6, 3, 4), np.float32),
    )
    drawn = draw(Drawer(bundle, [read_recording(tmp_path / "r.npz", spec)]))
    ids = {int(value) for each in drawn for value in each.observation["ids"]}
    assert ids == {3, 4, 5}
    assert {each.observation["rgb"].shape for each in drawn} == {(3, 4)}
    assert {bool(value) for each in drawn for value in each.observation["held"]} == {True, False}
    bare = draw(Drawer(bundle))
    assert {int(value) for each in bare for value in each.observation["ids"]} == {0}, "no range is known"
    assert {each.observation["rgb"].shape for each in bare} == {(3, 1)}


def test_without_text_inputs_of_other_samples_come_together(tmp_path: Path) -> None:
    spec = PolicySpec((TensorSpec("a", (1, 1)), TensorSpec("b", (1, 1))), (TensorSpec("action", (1, 2)),), 10.0)
    numbers = np.arange(50, dtype=np.float32)[:, None]
    np.savez(tmp_path / "r.npz", a=numbers, b=numbers)
    drawer = Drawer(Bundle(tmp_path, Manifest("x", "1", spec)), [read_recording(tmp_path / "r.npz", spec)])
    others = [each.observation for each in draw(drawer) if each.kind == "other"]
    assert any(each["a"] != each["b"] for each in others)


@pytest.mark.parametrize("seed", range(20))
def test_of_eight_drawn_states_each_element_is_at_both_ends(float_bundle: Bundle, seed: int) -> None:
    tensor = float_bundle.manifest.spec.inputs[1]
    drawer = Drawer(float_bundle)
    states = np.stack([each.observation["proprio"] for each in draw(drawer, 8, seed)])
    normalised = drawer._normalisers[tensor.name].forward(states)
    assert normalised.max(axis=0) == pytest.approx(EXTREME, abs=1e-3)
    assert normalised.min(axis=0) == pytest.approx(-EXTREME, abs=1e-3)


def test_a_file_gives_back_what_was_drawn(float_bundle: Bundle, recording, tmp_path: Path) -> None:
    drawn = draw(Drawer(float_bundle, [recording]), 12)
    save_drawn(tmp_path / "drawn.npz", drawn)
    found = read_drawn(tmp_path / "drawn.npz")
    assert [each.kind for each in found] == [each.kind for each in drawn]
    for one, other in zip(found, drawn, strict=True):
        assert one.observation["instruction"] == other.observation["instruction"]
        np.testing.assert_array_equal(one.observation["image"], other.observation["image"])
        assert one.observation["proprio"].dtype == np.float32


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2, "left": 3}}, ["go", "left"]),
        ({"model": {"vocab": {"<s>": 0, "\u0120pick": 1, "\u2581up": 2, "!": 3, "##ing": 4}}}, ["pick", "up"]),
        ({"model": {"vocab": [["<pad>", 0.0], ["\u2581cup", -1.5]]}}, ["cup"]),
    ],
)
def test_words_are_found_in_either_kind_of_file(tmp_path: Path, content, words) -> None:
    (tmp_path / "t.json").write_text(json.dumps(content))
    assert words_of(tmp_path / "t.json") == words


def test_a_vocabulary_without_words_gives_letters(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text('{"model": {}}')
    assert len(words_of(tmp_path / "t.json")) == 26


def test_a_vocabulary_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"The vocabulary .* cannot be read"):
        words_of(tmp_path / "none.json")
    (tmp_path / "t.json").write_text("[]")
    with pytest.raises(DataError, match="is not a mapping"):
        words_of(tmp_path / "t.json")
