"""A policy behind a camera: frames in recordings, in golden and drawn observations, and what its network is given."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _camera import camera_bundle, camera_source, frames

from vlatool.bundle.bundle import Bundle
from vlatool.data import Drawer, random_observations, read_recording, recorded_observations, synthetic_observations
from vlatool.data._calibration_checks import calibration_checks
from vlatool.errors import DataError
from vlatool.evaluate.recorded import Recorded
from vlatool.module.feeds import recorded_inputs
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.runtime.golden import load_goldens
from vlatool.stage.base import Context


@pytest.fixture(scope="session")
def source() -> Bundle:
    made: Bundle = camera_source()
    return made


@pytest.fixture(scope="session")
def exported() -> Bundle:
    made: Bundle = camera_bundle()
    return made


def seen(frame: Any) -> Any:
    """What the network is given of a frame of 16 x 20."""
    return np.moveaxis(frame[::2, 2:-2:2, ::-1], -1, 0)[None] / np.float32(255) * 2 - 1


def test_the_network_is_given_what_the_image_says(source: Bundle, exported: Bundle):
    first = frames(24, 1)[0]
    np.testing.assert_array_equal(recorded_inputs(source, 1)[0]["image"].numpy(), seen(first))
    observation = dict(recorded_observations(exported, 1)[0])
    policy = load(exported.path)
    encoded = policy.encode(observation)
    np.testing.assert_array_equal(encoded["image"], seen(first))
    np.testing.assert_array_equal(policy.infer(observation).chunk, policy.infer(encoded).chunk)


def test_the_golden_observations_are_frames_and_the_manifest_is_of_the_second_version(exported: Bundle):
    assert [golden[0]["image"].shape for golden in load_goldens(exported)] == [(16, 20, 3)] * 2
    assert exported.manifest.schema == 2
    assert load(exported.path).golden_error == pytest.approx(0, abs=1e-5)


def test_a_robot_gives_frames_of_any_size(exported: Bundle, observation: dict[str, Any]):
    policy = load(exported.path)
    for size in ((16, 16), (480, 640), (17, 1920)):
        given = {**observation, "image": np.zeros((*size, 3), np.uint8)}
        assert policy.infer(given).chunk.shape == (4, 2)
    with pytest.raises(DataError, match="crop takes 16x16 out of 15x640"):
        policy.infer({**observation, "image": np.zeros((15, 640, 3), np.uint8)})


def test_observations_that_nobody_recorded_are_frames_of_the_camera(exported: Bundle):
    spec = exported.manifest.spec
    recording = read_recording(exported.path / "data/calibration.npz", spec)
    drawer, random = Drawer(exported), np.random.default_rng(0)
    drawn = [each.observation for each in drawer.draw(4, random)]
    drawn += [each.observation for each in Drawer(exported, [recording]).draw(4, random)]
    for observation in (*drawn, *synthetic_observations(exported, 2), *random_observations(spec, 2)):
        image = observation["image"]
        assert (image.shape, image.dtype) == ((16, 20, 3), np.uint8)
        assert image.max() > 1


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((4, 20, 20, 3), np.float32), "float32; the policy takes uint8"),
        (np.zeros((4, 20, 20, 4), np.uint8), r"\[4, 20, 20, 4\]; wanted \[N, height, width, 3\]"),
        (np.zeros((4, 20, 20), np.uint8), r"\[4, 20, 20\]; wanted"),
        (np.zeros((4, 3, 8, 8), np.uint8), r"\[4, 3, 8, 8\]; wanted"),
        (np.zeros((4, 12, 20, 3), np.uint8), "frames of 12x20, of which its image makes no input"),
    ],
)
def test_recorded_frames_may_have_any_size_that_leads_to_the_input(
    exported: Bundle, tmp_path: Path, image: Any, words: str
):
    spec = exported.manifest.spec
    others = {"proprio": np.zeros((4, 3), np.float32), "instruction": np.array(["go"] * 4)}
    np.savez(tmp_path / "large.npz", image=np.zeros((4, 96, 128, 3), np.uint8), **others)
    assert read_recording(tmp_path / "large.npz", spec).observation(0)["image"].shape == (96, 128, 3)
    np.savez(tmp_path / "wrong.npz", image=image, **others)
    with pytest.raises(DataError, match=words):
        read_recording(tmp_path / "wrong.npz", spec)


def test_frames_that_look_normalised_are_noticed_before_a_calibration(exported: Bundle, tmp_path: Path):
    others = {"proprio": np.eye(4, 3, dtype=np.float32), "instruction": np.array(["go"] * 4)}
    np.savez(tmp_path / "dark.npz", image=np.ones((4, 16, 16, 3), np.uint8), **others)
    spec = exported.manifest.spec
    recording = read_recording(tmp_path / "dark.npz", spec)
    notes = calibration_checks(recording, range(4), spec, exported.path / "assets")
    assert any("looks normalised" in note for note in notes)


def test_it_is_quantized_and_evaluated_on_its_recordings(exported: Bundle, tmp_path: Path):
    (tmp_path / "int8").mkdir()
    StaticInt8().run(exported, tmp_path / "int8", Context())
    int8 = Bundle.open(tmp_path / "int8")
    (row,) = Recorded().run(int8, Context()).rows
    assert {each.name: each for each in row.measurements}["error_expert"].value < 0.3
    assert load(int8.path).golden_error is not None
