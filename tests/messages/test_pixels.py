"""Images as arrays: encodings, rows with padding, byte orders, colours, depth in metres."""

from __future__ import annotations

import numpy as np
import pytest

from vlatool.errors import BusError
from vlatool.messages import cdr, same
from vlatool.messages.builtin_interfaces import Time
from vlatool.messages.pixels import depth_m, image, image_message, rgb
from vlatool.messages.sensor_msgs import Image
from vlatool.messages.std_msgs import Header

PIXELS = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)


def _image(encoding: str, array: np.ndarray, big: bool = False, padding: int = 0) -> Image:
    """An image whose rows have bytes of padding, with the numbers in either byte order."""
    stored = array.astype(array.dtype.newbyteorder(">" if big else "<")).reshape(array.shape[0], -1)
    rows = np.pad(stored.view(np.uint8), ((0, 0), (0, padding)), constant_values=99)
    return Image(Header(), *array.shape[:2], encoding, int(big), rows.shape[1], np.ascontiguousarray(rows).reshape(-1))


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 8])
@pytest.mark.parametrize(("encoding", "dtype", "channels"), [
    ("rgb8", "uint8", 3), ("bgra8", "uint8", 4), ("mono8", "uint8", 1), ("mono16", "uint16", 1),
    ("rgb16", "uint16", 3), ("bayer_rggb8", "uint8", 1), ("yuv422", "uint8", 2), ("8UC1", "uint8", 1),
    ("8UC3", "uint8", 3), ("8SC2", "int8", 2), ("16UC1", "uint16", 1), ("16SC1", "int16", 1), ("32SC1", "int32", 1),
    ("32FC1", "float32", 1), ("32FC", "float32", 1), ("32FC4", "float32", 4), ("64FC1", "float64", 1),
])  # fmt: skip
def test_pixels_of_every_encoding(encoding: str, dtype: str, channels: int, padding: int, big: bool) -> None:
    shape = (4, 6) if channels == 1 else (4, 6, channels)
    array = (PIXELS[:, :, :1].reshape(4, 6) if channels == 1 else np.resize(PIXELS, shape)).astype(dtype)
    pixels = image(_image(encoding, array, big, padding))
    assert same(pixels, array)
    assert not pixels.flags.writeable


def test_pixels_are_a_view_of_the_bytes() -> None:
    encoded = cdr.encode(image_message(PIXELS, "rgb8"))
    assert np.shares_memory(image(cdr.decode(Image, encoded)), np.frombuffer(encoded, np.uint8))


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "8UC4", "rgb16", "bgra16"])
def test_colours_are_red_green_blue(encoding: str) -> None:
    wide = encoding.endswith("16")
    stored = PIXELS if encoding.startswith("rgb") else PIXELS[:, :, ::-1]
    if "a" in encoding or encoding == "8UC4":
        stored = np.concatenate([stored, np.full((4, 6, 1), 7, np.uint8)], axis=2)
    message = _image(encoding, stored.astype(np.uint16) * 256 + 5 if wide else stored, padding=4)
    assert same(rgb(message), PIXELS)


def test_grey_is_repeated() -> None:
    grey = PIXELS[:, :, 0]
    for message in (_image("mono8", grey), _image("8UC1", grey), _image("mono16", grey.astype(np.uint16) * 256 + 9)):
        assert same(rgb(message), np.stack([grey] * 3, axis=2))


@pytest.mark.parametrize(("yuv", "colour"), [
    ((16, 128, 128), (0, 0, 0)), ((235, 128, 128), (255, 255, 255)), ((81, 90, 240), (254, 0, 0)),
    ((145, 54, 34), (0, 255, 1)), ((41, 240, 110), (0, 0, 255)),
])  # fmt: skip
@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_yuv_is_bt601(encoding: str, yuv: tuple[int, int, int], colour: tuple[int, int, int]) -> None:
    """Black, white and the saturated colours of ITU-R BT.601's colour bars, within a step of rounding."""
    y, u, v = yuv
    pair = [u, y, v, y] if encoding in ("yuv422", "uyvy") else [y, u, y, v]
    array = np.tile(np.array(pair, np.uint8), (2, 3)).reshape(2, 6, 2)
    assert np.abs(rgb(_image(encoding, array)).astype(int) - colour).max() <= 1


def test_yuv_keeps_the_columns_apart() -> None:
    array = np.array([[[90, 81], [240, 81], [240, 41], [110, 41]]], np.uint8)  # U Y V Y: two red, two blue
    assert (rgb(_image("uyvy", array))[0].argmax(axis=1) == [0, 0, 2, 2]).all()
    with pytest.raises(BusError, match="3 pixels in a row"):
        rgb(_image("uyvy", array[:, :3]))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaic_is_interpolated(pattern: str, bits: int) -> None:
    """A linear ramp of each colour comes back exactly inside; at the border, from the neighbours that there are."""
    rows, columns = np.mgrid[:8, :10]
    truth = np.stack([10 + 4 * rows + 2 * columns, 50 + 2 * rows + 6 * columns, 200 - 8 * rows - 4 * columns], axis=2)
    mosaic = np.zeros((8, 10), f"uint{bits}")
    for index, colour in enumerate(pattern):
        cell = (slice(index // 2, None, 2), slice(index % 2, None, 2))
        mosaic[cell] = truth[(*cell, "rgb".index(colour))] << (bits - 8)
    colours = rgb(_image(f"bayer_{pattern}{bits}", mosaic)).astype(int)
    assert (colours[1:-1, 1:-1] == truth[1:-1, 1:-1]).all()
    assert np.abs(colours - truth).max() <= 8 + 4  # a row and a column of the steepest ramp


def test_depth_in_metres() -> None:
    millimetres = np.array([[0, 1, 1500], [65535, 750, 40]], np.uint16)
    metres = np.array([[np.nan, 0.001, 1.5], [65.535, 0.75, 0.04]], np.float32)
    for encoding in ("16UC1", "mono16"):
        for big in (False, True):
            depth = depth_m(_image(encoding, millimetres, big, padding=2))
            assert depth.dtype == np.float32
            np.testing.assert_allclose(depth, metres, rtol=1e-6)
    unknown = np.array([[np.nan, np.inf, -np.inf], [0.0, -1.0, 2.5]])
    expected = [[np.nan] * 3, [np.nan, np.nan, 2.5]]
    np.testing.assert_array_equal(depth_m(_image("32FC1", unknown.astype(np.float32))), expected)
    np.testing.assert_array_equal(depth_m(_image("64FC1", unknown)), expected)
    assert np.isnan(depth_m(_image("64FC1", np.array([[1e300]])))).all()


@pytest.mark.parametrize(("message", "problem"), [
    (Image(), "Unknown encoding ''"),
    (Image(height=1, width=1, encoding="h264", step=1), "Unknown encoding 'h264'.*rgb8"),
    (Image(height=1, width=1, encoding="8FC1", step=1), "Unknown encoding '8FC1'"),
    (Image(height=1, width=1, encoding="64UC0", step=1), "Unknown encoding '64UC0'"),
    (Image(encoding="rgb8"), "of 0 x 0 pixels"),
    (Image(height=2, width=2, encoding="rgb8", step=5, data=np.zeros(99, np.uint8)), "rows of 5 bytes.*a row takes 6"),
    (Image(height=2, width=2, encoding="rgb8", step=6, data=np.zeros(11, np.uint8)), "11 bytes in all.*12 or more"),
    (Image(height=2**32 - 1, width=2**32 - 1, encoding="32FC999", step=2**32 - 1), "a row takes"),
])  # fmt: skip
def test_images_that_do_not_fit(message: Image, problem: str) -> None:
    for function in (image, rgb, depth_m):
        with pytest.raises(BusError, match=f"(?s){problem}|not be|must be"):
            function(message)
    with pytest.raises(BusError, match=f"(?s){problem}"):
        image(message)


def test_colour_is_not_depth_and_depth_has_no_colours() -> None:
    with pytest.raises(BusError, match="in rgb8; it must be in 16UC1"):
        depth_m(image_message(PIXELS, "rgb8"))
    with pytest.raises(BusError, match="32FC1, which has no colours"):
        rgb(image_message(np.zeros((2, 2), np.float32), "32FC1"))


def test_message_of_pixels() -> None:
    header = Header(Time(3, 4), "camera")
    message = image_message(PIXELS, "bgr8", header)
    assert (message.height, message.width, message.step, message.is_bigendian) == (4, 6, 18, 0)
    assert message.header is header
    assert np.shares_memory(message.data, PIXELS)
    depth = np.array([[1.5, np.nan]], np.float32)
    for array, encoding in ((depth, "32FC1"), (PIXELS[::2, ::-1], "rgb8"), (PIXELS[:, :, 0], "mono8")):
        assert same(image(cdr.decode(Image, cdr.encode(image_message(array, encoding)))), array.copy())
    for array, encoding in (
        (PIXELS, "mono8"),
        (PIXELS.astype(float), "rgb8"),
        (PIXELS[0, 0], "rgb8"),
        (depth, "16UC1"),
    ):
        with pytest.raises(BusError, match="it takes"):
            image_message(array, encoding)
