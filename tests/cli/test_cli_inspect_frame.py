"""``vlatool inspect BUNDLE --frame FILE``: what the network sees of a frame, in numbers and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _camera import camera_bundle

pil = pytest.importorskip("PIL.Image")


@pytest.fixture
def bundle() -> Path:
    path: Path = camera_bundle().path
    return path


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    """A picture whose left half is red and whose right half is blue."""
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:, :8, 0], pixels[:, 8:, 2] = 255, 255
    pil.fromarray(pixels).save(tmp_path / "f.png")
    return tmp_path / "f.png"


def test_it_says_and_shows_what_the_network_sees(vlatool: Any, bundle: Path, frame: Path, tmp_path: Path):
    seen = tmp_path / "seen.png"
    code, out, err = vlatool("inspect", bundle, "--frame", frame, "-o", seen)
    assert (code, err) == (0, "")
    assert "of bgr frames to rgb, crop to 16x16, resize to 8x8 nearest as opencv does, -1 to 1" in out
    assert f"frame      {frame}: 16x16x3 bgr" in out
    assert "sees       image: float32 1x3x8x8, -1 to 1, mean of r 0, g -1, b 0" in out
    picture = np.asarray(pil.open(seen))
    assert picture.shape == (16, 32, 3)
    assert np.array_equal(picture[:, :16], np.asarray(pil.open(frame)))
    assert np.array_equal(picture[:8, 24:], np.asarray(pil.open(frame))[::2, ::2])
    assert vlatool("inspect", bundle, "--frame", frame, "-o", seen)[0] == 3
    assert vlatool("inspect", bundle, "--frame", frame, "-o", seen, "--force")[0] == 0


def test_a_frame_may_be_an_array_as_the_camera_gives_it(vlatool: Any, bundle: Path, tmp_path: Path):
    blue = np.zeros((480, 640, 3), np.uint8)
    blue[..., 0] = 255
    np.save(tmp_path / "f.npy", blue)
    code, out, _ = vlatool("inspect", bundle, "--frame", f"image={tmp_path / 'f.npy'}")
    assert code == 0
    assert "480x640x3 bgr" in out
    assert "mean of r -1, g -1, b 1" in out


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("f.png", b"", "cannot be read"),
        ("f.png", b"\x89PNG\r\n\x1a\n" + bytes(64), "cannot be read"),
        ("f.txt", b"no picture", "cannot be read"),
        ("f.npy", b"\x93NUMPY", "cannot be read"),
        ("absent.png", None, "cannot be read"),
    ],
)
def test_a_file_that_is_no_frame_is_refused(
    vlatool: Any, bundle: Path, tmp_path: Path, name: str, content: bytes | None, words: str
):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    code, _, err = vlatool("inspect", bundle, "--frame", tmp_path / name)
    assert code == 3
    assert words in err
    assert str(tmp_path / name) in err


def test_a_truncated_picture_and_an_array_of_another_kind_are_refused(
    vlatool: Any, bundle: Path, frame: Path, tmp_path: Path
):
    (tmp_path / "half.png").write_bytes(frame.read_bytes()[:-30])
    assert vlatool("inspect", bundle, "--frame", tmp_path / "half.png")[0] == 3
    np.save(tmp_path / "float.npy", np.zeros((16, 16, 3)))
    code, _, err = vlatool("inspect", bundle, "--frame", tmp_path / "float.npy")
    assert code == 3
    assert "float64; a camera frame is uint8" in err
    np.save(tmp_path / "pickled.npy", np.array([{}]), allow_pickle=True)
    assert vlatool("inspect", bundle, "--frame", tmp_path / "pickled.npy")[0] == 3


def test_what_makes_no_sense_together_is_refused(
    vlatool: Any, bundle: Path, float_bundle: Any, frame: Path, tmp_path: Path
):
    assert "0 inputs that are images" in vlatool("inspect", float_bundle.path, "--frame", frame)[2]
    assert vlatool("inspect", bundle, "--frame", frame, "--json")[0] == 2
    assert vlatool("inspect", bundle, "-o", tmp_path / "seen.png")[0] == 2
    code, _, err = vlatool("inspect", bundle, "--frame", frame, "-o", tmp_path / "seen.jpg")
    assert code == 3
    assert "ends in .png" in err
