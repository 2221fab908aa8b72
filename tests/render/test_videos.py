"""Videos, written by each format and decoded again."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vlatool.errors import MissingExtra, OutputError, UsageError
from vlatool.files.user_files import is_own_file
from vlatool.render import video
from vlatool.render.video import Picture, Video, check_video, write_video
from vlatool.render.videos import gif, mp4

COLOURS = np.array([[20, 23, 26], [231, 60, 20], [10, 200, 90], [30, 60, 240]], np.uint8)


def moving(count: int = 12, height: int = 40, width: int = 60) -> Iterator[Picture]:
    """A square that moves over a ground of three colours."""
    for step in range(count):
        picture = COLOURS[np.add.outer(np.arange(height), np.arange(width)) // 20 % 3]
        picture[5:15, step * 2 : step * 2 + 10] = COLOURS[3]
        yield picture


def noise(count: int, height: int, width: int) -> Iterator[Picture]:
    random = np.random.default_rng(0)
    for _ in range(count):
        yield random.integers(0, 256, (height, width, 3), np.uint8)


def decoded(path: Path) -> tuple[list[Picture], list[int]]:
    """All pictures of a GIF, and how long each is shown, in ms."""
    with Image.open(path) as image:
        pictures, times = [], []
        for frame in range(image.n_frames):
            image.seek(frame)
            pictures.append(np.asarray(image.convert("RGB")))
            times.append(image.info["duration"])
        assert image.info["loop"] == 0
    return pictures, times


def test_a_gif_shows_every_picture_at_the_control_rate(tmp_path: Path):
    path = tmp_path / "a.gif"
    assert write_video(Video(moving, 12, 20.0), path) == ""
    pictures, times = decoded(path)
    assert len(pictures) == 12
    for shown, picture in zip(pictures, moving(), strict=True):
        assert np.abs(shown.astype(int) - picture).max() <= 8, "few colours are kept as they are, but for rounding"
    assert times == [50] * 11 + [2050]


@pytest.mark.parametrize(("hz", "expected"), [(3.0, [330, 340, 330]), (30.0, [30, 40, 30]), (12.5, [80, 80, 80])])
def test_delays_add_up_to_real_time(tmp_path: Path, hz: float, expected: list[int]):
    write_video(Video(moving, 12, hz), tmp_path / "a.gif")
    times = decoded(tmp_path / "a.gif")[1]
    assert times[:3] == expected
    assert sum(times) == pytest.approx(12e3 / hz + 2000, abs=10)


def test_above_fifty_pictures_a_second_some_are_left_out_and_it_is_said(tmp_path: Path):
    lacks = write_video(Video(moving, 12, 120.0), tmp_path / "a.gif")
    pictures, times = decoded(tmp_path / "a.gif")
    assert lacks == "one in 3 pictures"
    assert len(pictures) == 5, "0, 3, 6, 9 and the last one"
    assert min(times) >= 20
    assert np.abs(pictures[-1].astype(int) - list(moving())[-1]).max() <= 8


def test_what_stands_still_is_stored_once(tmp_path: Path):
    def still() -> Iterator[Picture]:
        yield from [next(moving())] * 30

    write_video(Video(still, 30, 10.0), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 1
        assert image.info["duration"] == 5000


def test_inks_keep_their_colours_among_many_others(tmp_path: Path):
    ink = (111, 211, 155)

    def written() -> Iterator[Picture]:
        for picture in noise(3, 64, 64):
            picture[2, 2] = ink
            yield picture

    write_video(Video(written, 3, 10.0, (ink,)), tmp_path / "a.gif")
    assert np.abs(decoded(tmp_path / "a.gif")[0][1][2, 2].astype(int) - ink).max() <= 8


def test_a_gif_of_noise_is_bounded_by_fewer_colours_and_pictures(tmp_path: Path):
    def large() -> Iterator[Picture]:
        for picture in noise(60, 96, 192):
            yield picture.repeat(2, 0).repeat(2, 1)

    lacks = write_video(Video(large, 60, 20.0), tmp_path / "a.gif")
    assert lacks == "one in 4 pictures"
    assert (tmp_path / "a.gif").stat().st_size <= gif.LEAST_BYTES


def test_one_picture_is_a_video_too(tmp_path: Path):
    write_video(Video(lambda: moving(1), 1, 10.0), tmp_path / "a.gif")
    assert len(decoded(tmp_path / "a.gif")[0]) == 1


def played(path: Path, height: int, width: int) -> list[Picture]:
    """All pictures of an MP4."""
    import subprocess

    command = [mp4.program(), "-loglevel", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return list(np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3))


def test_an_mp4_shows_every_picture_and_holds_the_last(tmp_path: Path):
    path = tmp_path / "a.mp4"
    assert write_video(Video(lambda: moving(8, 41, 61), 8, 10.0), path) == ""
    pictures = played(path, 42, 62)
    assert len(pictures) == 8 + 20
    for shown, picture in zip(pictures, moving(8, 41, 61), strict=False):
        assert np.abs(shown[:41, :61].astype(int) - picture).mean() < 8
    assert np.abs(pictures[-1].astype(int) - pictures[7]).mean() < 2


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_video_is_known_again_until_somebody_changes_it(tmp_path: Path, suffix: str):
    path = tmp_path / f"a.{suffix}"
    write_video(Video(moving, 12, 20.0), path)
    assert is_own_file(path)
    with pytest.raises(OutputError, match="exists already"):
        check_video(path, force=False)
    check_video(path, force=True)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(OutputError, match="was not written by vlatool, or was changed since"):
        check_video(path, force=True)


@pytest.mark.parametrize(("name", "error", "says"), [
    ("a", UsageError, "known: gif, mp4"), ("a.avi", UsageError, "'avi' is none"),
    ("a.gfi", UsageError, "did you mean 'gif'"), ("a.gif/b.gif", OutputError, "there is no folder"),
    ("none/b.gif", OutputError, "there is no folder"), (".", UsageError, "known"),
])  # fmt: skip
def test_what_is_named_wrongly_is_said_before_the_work(tmp_path: Path, name: str, error: type[Exception], says: str):
    with pytest.raises(error, match=says):
        check_video(tmp_path / name, force=False)


def test_a_link_is_not_written_through(tmp_path: Path):
    (tmp_path / "a.gif").symlink_to(tmp_path / "b.gif")
    with pytest.raises(OutputError, match="is a link"):
        check_video(tmp_path / "a.gif", force=True)


def test_a_full_disk_is_known_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(video, "ROOM", 1 << 62)
    with pytest.raises(OutputError, match="the disk is full"):
        check_video(tmp_path / "a.gif", force=False)


def test_without_an_encoder_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra, match="An mp4 needs ffmpeg, and there is none on PATH") as caught:
        check_video(tmp_path / "a.mp4", force=False)
    assert "vlatool[mp4]" in caught.value.fix
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtra, match="'PIL', which the extra 'video' provides"):
        check_video(tmp_path / "a.gif", force=False)


def test_an_ffmpeg_that_fails_is_told_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\necho 'no such codec' >&2\nexit 3\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(OutputError, match="ffmpeg could not write the video: no such codec"):
        write_video(Video(moving, 12, 20.0), tmp_path / "a.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_an_ffmpeg_without_h264_writes_mpeg4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(mp4, "CODECS", (("-c:v", "no_such_codec"), mp4.CODECS[1]))
    write_video(Video(moving, 12, 20.0), tmp_path / "a.mp4")
    assert len(played(tmp_path / "a.mp4", 40, 60)) == 12 + 40


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_a_video_appears_whole_or_not_at_all(tmp_path: Path, name: str):
    def full() -> Iterator[Picture]:
        yield from moving(3)
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="the disk is full"):
        write_video(Video(full, 12, 20.0), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_came_meanwhile_is_not_replaced(tmp_path: Path):
    def slowly() -> Iterator[Picture]:
        (tmp_path / "a.gif").write_bytes(b"mine")
        yield from moving(3)

    for force in (False, True):
        with pytest.raises(OutputError, match="exists already" if not force else "was not written by vlatool"):
            write_video(Video(slowly, 3, 20.0), tmp_path / "a.gif", force=force)
    assert (tmp_path / "a.gif").read_bytes() == b"mine"
    assert len(list(tmp_path.iterdir())) == 1


def test_of_two_writers_of_one_video_the_second_is_told(tmp_path: Path):
    def slowly() -> Iterator[Picture]:
        write_video(Video(lambda: moving(2), 2, 20.0), tmp_path / "a.gif", force=True)
        yield from moving(3)

    with pytest.raises(OutputError, match="exists already"):
        write_video(Video(slowly, 3, 20.0), tmp_path / "a.gif")
    write_video(Video(slowly, 3, 20.0), tmp_path / "a.gif", force=True)


def test_formats_are_found_by_their_files():
    assert isinstance(video.format_of(Path("A.GIF")), gif.Gif)
    assert isinstance(video.format_of(Path("b.mp4")), mp4.Mp4)
