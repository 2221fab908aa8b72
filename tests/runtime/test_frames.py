"""Frames -> what the network sees, against the arithmetic of the libraries, and frames that are none."""

import importlib
import sys
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError
from vlatool.runtime.observation import ObservationEncoder

RANDOM = np.random.default_rng(0)
RESIZE = {"steps": [{"op": "resize", "size": [24, 32]}]}


def frame(*shape: int) -> Any:
    return np.random.default_rng(1).integers(0, 256, shape, np.uint8)


def encode(image: dict[str, Any], value: Any, shape: tuple[int, ...] = (1, 3, 24, 32), dtype: str = "float32") -> Any:
    given = TensorSpec.from_dict({"name": "top", "shape": list(shape), "dtype": dtype, "image": image})
    spec = PolicySpec((given,), (TensorSpec("action", (1, 1)),), 10)
    encoded = ObservationEncoder(spec, None)({"top": value})["top"]  # type: ignore[arg-type]
    assert (encoded.shape, encoded.dtype) == (shape, np.dtype(dtype))
    assert encoded.flags.c_contiguous
    return encoded


def test_the_numbers_are_those_of_torch_to_the_last_bit():
    torch = pytest.importorskip("torch")
    mean, std = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
    raw = frame(24, 32, 3)
    pixels = torch.from_numpy(raw).permute(2, 0, 1)[None].float() / 255
    columns = (torch.tensor(numbers)[:, None, None] for numbers in (mean, std))
    wanted = pixels.sub(next(columns)).div(next(columns)).numpy()
    assert np.array_equal(encode({"range": [0, 1], "mean": mean, "std": std}, raw), wanted)
    assert np.array_equal(encode({"range": [-1, 1]}, raw), (pixels * 2 - 1).numpy())
    assert np.array_equal(encode({"range": [0, 1], "mean": 0.5, "std": 0.5}, raw), ((pixels - 0.5) / 0.5).numpy())


def test_a_padded_resize_is_openpis():
    pil = pytest.importorskip("PIL.Image")
    raw = frame(48, 96, 3)
    small = pil.fromarray(raw).resize((32, 16), pil.BILINEAR)
    canvas = pil.new("RGB", (32, 24), 0)
    canvas.paste(small, (0, 4))
    steps = [{"op": "resize", "size": [24, 32], "fit": "contain"}, {"op": "pad", "size": [24, 32]}]
    got = encode({"steps": steps, "layout": "hwc"}, raw, (1, 24, 32, 3), "uint8")
    assert np.array_equal(got[0], np.asarray(canvas))


def test_smolvla_pads_above_and_left():
    torch = pytest.importorskip("torch")
    raw = frame(48, 96, 3)
    pixels = torch.from_numpy(raw).permute(2, 0, 1)[None].float() / 255
    small = torch.nn.functional.interpolate(pixels, size=(16, 32), mode="bilinear", align_corners=False)
    wanted = torch.nn.functional.pad(small, (0, 0, 8, 0), value=0) * 2 - 1
    steps = [{"op": "resize", "size": [24, 32], "fit": "contain"}, {"op": "pad", "size": [24, 32], "side": "start"}]
    got = encode({"steps": steps, "like": "torch", "range": [-1, 1]}, raw)
    assert np.abs(got - wanted.numpy()).max() < 1e-5


@pytest.mark.parametrize(
    ("order", "channels", "index"),
    [("bgr", "rgb", [2, 1, 0]), ("rgba", "rgb", [0, 1, 2]), ("bgra", "bgr", [0, 1, 2]), ("rgb", "bgr", [2, 1, 0]),
     ("bgra", "rgba", [2, 1, 0, 3]), ("rgba", "bgr", [2, 1, 0])],
)  # fmt: skip
def test_channels_are_put_into_the_order_of_the_network(order: str, channels: str, index: list[int]):
    raw = frame(24, 32, len(order))
    image = {"frame": order, "channels": channels, "layout": "hwc"}
    got = encode(image, raw, (1, 24, 32, len(channels)), "uint8")
    assert np.array_equal(got[0], raw[:, :, index])


@pytest.mark.parametrize("axes", [(24, 32), (24, 32, 1), (1, 24, 32, 1)])
def test_a_grey_frame_fills_all_channels(axes: tuple[int, ...]):
    raw = frame(*axes)
    got = encode({"frame": "grey"}, raw)
    assert np.array_equal(got[0], np.repeat(raw.reshape(1, 24, 32), 3, 0))
    assert np.array_equal(encode({"frame": "grey", "channels": "grey", "layout": "hw"}, raw, (1, 24, 32))[0], got[0, 0])


def test_a_colour_is_the_grey_of_pil():
    pil = pytest.importorskip("PIL.Image")
    raw = frame(24, 32, 3)
    got = encode({"frame": "bgr", "channels": "grey"}, raw[:, :, ::-1], (1, 1, 24, 32), "uint8")
    assert np.array_equal(got[0, 0], np.asarray(pil.fromarray(raw).convert("L")))


def test_an_opacity_is_untouched_where_the_size_stays():
    pil = pytest.importorskip("PIL.Image")
    raw, version = frame(48, 32, 4), int(importlib.import_module("PIL").__version__.partition(".")[0])
    for size in ((48, 32), (24, 32), (20, 50)):
        image = {"frame": "rgba", "channels": "rgba", "layout": "hwc", "like": "pil13" if version > 12 else "pil",
                 "steps": [{"op": "resize", "size": list(size), "filter": "bicubic"}]}  # fmt: skip
        wanted = np.asarray(pil.fromarray(raw).resize(size[::-1], pil.BICUBIC))
        assert np.array_equal(encode(image, raw, (1, *size, 4), "uint8")[0], wanted)


def test_a_border_has_the_colour_that_it_is_given():
    image = {"steps": [{"op": "crop", "box": [2, 3, 10, 20]}, {"op": "pad", "size": [24, 32], "value": [1, 2, 3]}]}
    raw = frame(24, 64, 3)
    got = encode(image, raw)
    assert got[0, :, 0, 0].tolist() == [1, 2, 3]
    assert np.array_equal(got[0, :, 7:17, 6:26], raw[2:12, 3:23].transpose(2, 0, 1))
    grey = encode({**image, "frame": "grey"}, raw[:, :, 0])
    assert grey[0, :, -1, -1].tolist() == [1, 2, 3]


@pytest.mark.parametrize(("like", "top"), [("pil", 1), ("torch_uint8", 2)])
def test_half_a_pixel_of_a_crop_is_rounded_as_the_library_does(like: str, top: int):
    raw = frame(27, 35, 3)
    got = encode({"steps": [{"op": "crop", "size": [24, 32]}], "like": like, "layout": "hwc"}, raw, (1, 24, 32, 3))
    assert np.array_equal(got[0], raw[top : top + 24, top : top + 32])


@pytest.mark.parametrize("view", [np.s_[::-1], np.s_[:, ::-1], np.s_[..., ::-1], np.s_[::2, ::3], np.s_[5:70, 7:]])
def test_a_view_is_a_frame_whatever_its_strides_are(view: Any):
    raw = frame(90, 120, 3)[view]
    before = raw.copy()
    assert np.array_equal(encode(RESIZE, raw), encode(RESIZE, before))
    assert np.array_equal(raw, before)


def test_a_frame_may_be_read_only_and_of_another_size_each_time():
    given = TensorSpec.from_dict({"name": "top", "shape": [1, 3, 24, 32], "image": RESIZE})
    spec = PolicySpec((given,), (TensorSpec("action", (1, 1)),), 10)
    encode_all = ObservationEncoder(spec, None)  # type: ignore[arg-type]
    for height in range(1, 40):
        raw = frame(height, 41 - height, 3)
        raw.flags.writeable = False
        first, again = (encode_all({"top": raw})["top"] for _ in range(2))
        assert first.shape == (1, 3, 24, 32)
        assert np.array_equal(first, again)


def test_a_frame_of_one_colour_keeps_it():
    for like in ("pil", "pil13", "opencv", "torch", "torch_uint8"):
        for kind in ("nearest", "bilinear", "bicubic", "area"):
            image = {"like": like, "steps": [{"op": "resize", "size": [24, 32], "filter": kind}]}
            for shape in ((7, 9, 3), (480, 640, 3), (24, 99, 3)):
                assert np.abs(encode(image, np.full(shape, 255, np.uint8)) - 255).max() < 1e-3, (like, kind, shape)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.zeros((48, 64, 3), np.float32), "float32; a camera frame is uint8"),
        (np.zeros((48, 64, 3), np.int64), "int64; a camera frame is uint8"),
        (np.zeros((48, 64, 3), bool), "bool; a camera frame is uint8"),
        (np.zeros((48, 64, 5), np.uint8), r"\[48, 64, 5\].*rgb frames, \[H, W, 3\]"),
        (np.zeros((48, 64), np.uint8), r"\[48, 64\].*rgb frames"),
        (np.zeros((48, 64, 1), np.uint8), r"\[48, 64, 1\].*rgb frames"),
        (np.zeros((3, 48, 64), np.uint8), r"\[3, 48, 64\].*rgb frames"),
        (np.zeros((2, 48, 64, 3), np.uint8), r"\[2, 48, 64, 3\]"),
        (np.zeros((0, 64, 3), np.uint8), "at least one pixel"),
        (np.zeros((48, 0, 3), np.uint8), "at least one pixel"),
        (np.uint8(3), r"\[\].*rgb frames"),
        (None, "object; a camera frame is uint8"),
        ("frame.png", "a camera frame is uint8"),
        ([[1, 2], [3]], "rows have different lengths"),
    ],
)
def test_what_is_no_frame_is_refused(value: Any, words: str):
    with pytest.raises(DataError, match=words) as caught:
        encode(RESIZE, value)
    assert "top" in caught.value.message
    assert caught.value.fix


@pytest.mark.parametrize(
    ("image", "size", "words"),
    [
        ({}, (25, 32), "25x32: its image makes 25x32 of it"),
        ({"steps": [{"op": "crop", "size": [24, 32]}]}, (20, 640), "crop takes 24x32 out of 20x640"),
        ({"steps": [{"op": "pad", "size": [24, 32]}]}, (24, 33), "pad makes 24x32 of 24x33"),
    ],
)
def test_a_frame_of_a_size_that_leads_nowhere_is_refused(image: dict[str, Any], size: tuple[int, int], words: str):
    with pytest.raises(DataError, match=words):
        encode(image, frame(*size, 3))


def test_the_runtime_needs_no_library_for_frames():
    from vlatool.runtime import image, resampling

    names = {name.partition(".")[0] for module in (image, resampling) for name in vars(module)}
    assert not names & {"PIL", "cv2", "torch", "scipy"}
    assert "vlatool.runtime.resampling" in sys.modules
