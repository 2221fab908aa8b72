"""A camera frame -> what the network sees: colours, crop, resize, pad and numbers, as ``spec.inputs[].image`` says."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.image import LAYOUTS, ORDERS, Image, ImageStep
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError
from vlatool.runtime.resampling import resampler

Array = NDArray[Any]
Step = Callable[[Array], Array]
MAX_PLANS = 16
"""Sizes of frames whose weights are kept."""
FIX = "give the frame as the camera has it: uint8, 0 to 255"


class FrameEncoder:
    """Turns frames into an input, in the shape and dtype that its spec declares.

    What depends on the size of a frame is computed once for each size. Several threads may call it.
    """

    def __init__(self, tensor: TensorSpec, image: Image) -> None:
        self._tensor, self._image = tensor, image
        self._plans: dict[tuple[int, int], list[Step]] = {}
        self._colours = _colours(image)
        self._numbers = _Numbers(image, tensor.dtype)
        self._axes = None if image.layout == "hw" else tuple("chw".index(axis) for axis in image.layout)
        self._leading = (1,) * (len(tensor.shape) - LAYOUTS[image.layout])

    def __call__(self, value: Any) -> Array:
        """Return an input.

        Args:
            value: uint8 (H, W, C), or (H, W) in grey; a batch axis of 1 may stand before. Any strides.

        Raises:
            DataError: for another dtype or number of axes or channels, an empty frame, and a size of which the steps
                make no input.
        """
        frame = self._checked(np.asarray(value))
        size = (len(frame), frame.shape[1])
        picture = self._colours(frame)
        plan = self._plans.get(size)
        for step in self._plan(size) if plan is None else plan:
            picture = step(picture)
        planes = self._numbers(picture)
        ordered = planes[0] if self._axes is None else planes.transpose(self._axes)
        return np.ascontiguousarray(ordered).reshape(*self._leading, *ordered.shape)

    def _checked(self, frame: Array) -> Array:
        """Return a frame as (H, W, C)."""
        channels = ORDERS[self._image.frame]
        batched = frame.ndim == 4 or (frame.ndim == 3 and channels == 1 and frame.shape[-1] != 1)
        if batched and frame.shape[0] == 1:
            frame = frame[0]
        if frame.ndim == 2 and channels == 1:
            frame = frame[:, :, None]
        if frame.dtype != np.uint8:
            raise DataError(f"The frame '{self._tensor.name}' is {frame.dtype}; a camera frame is uint8.", FIX)
        if frame.ndim != 3 or frame.shape[2] != channels or not frame.size:
            wanted = "[H, W]" if channels == 1 else f"[H, W, {channels}]"
            raise DataError(
                f"The frame '{self._tensor.name}' has the shape {list(frame.shape)}; the policy takes "
                f"{self._image.frame} frames, {wanted}, of at least one pixel.",
                "give what the camera gives, or correct 'frame' of the image in the spec",
            )
        return frame

    def _plan(self, size: tuple[int, int]) -> list[Step]:
        """Return what is done to frames of a size.

        Raises:
            DataError: when that leads to no input.
        """
        image, tensor, before = self._image, self._tensor, size
        if not image.makes(size, tensor.shape):
            raise DataError(
                f"The frame '{tensor.name}' is {size[0]}x{size[1]}: {_reason(image, size)}. The policy takes "
                f"{list(tensor.shape)}.",
                "give larger frames, or let the image in the spec resize them",
            )
        steps = []
        for step in image.steps:
            steps.append(_step(step, image, before))
            before = step.size_after(before, image.like)
        if len(self._plans) >= MAX_PLANS:
            self._plans = {}
        self._plans[size] = steps
        return steps


def _reason(image: Image, size: tuple[int, int]) -> str:
    try:
        made = image.size_after(size)
    except ValueError as error:
        return str(error)
    return f"its image makes {made[0]}x{made[1]} of it"


class _Numbers:
    """Pixels of 0 to 255 -> the numbers of the network, in float32 step by step as torch computes them."""

    def __init__(self, image: Image, dtype: str) -> None:
        self._dtype, self._channels = np.dtype(dtype), ORDERS[image.channels]
        low, high = image.range
        self._factor = () if (low, high) == (0.0, 255.0) else (np.float32(255), np.float32(high - low), np.float32(low))
        self._mean, self._std = (
            np.broadcast_to(np.array(numbers, np.float32), self._channels if numbers else 0)
            for numbers in (image.mean, image.std)
        )

    def __call__(self, picture: Array) -> Array:
        """Return (C, H, W) of a picture (H, W, C), or (H, W, 1) whose channels are all the same."""
        planes = np.empty((self._channels, *picture.shape[:2]), np.uint8 if self._dtype == np.uint8 else np.float32)
        for channel, plane in enumerate(planes):
            plane[...] = picture[:, :, min(channel, picture.shape[2] - 1)]
        if self._factor:
            most, span, low = self._factor
            planes /= most
            planes *= span
            planes += low
        for channel, mean in enumerate(self._mean):
            planes[channel] -= mean
        for channel, std in enumerate(self._std):
            planes[channel] /= std
        return planes.astype(self._dtype, copy=False)


def _colours(image: Image) -> Step:
    """Return what makes the network's channels of a frame; a grey frame stays one channel until the end."""
    frame, network = image.frame, image.channels
    if frame == "grey" or frame == network:
        return lambda picture: picture
    if network == "grey":
        return partial(_grey, red=frame.index("r"), like=image.like)
    order = [frame.index(channel) for channel in network]
    views: dict[tuple[int, ...], slice] = {(0, 1, 2): slice(3), (2, 1, 0): slice(2, None, -1)}
    chosen = views.get(tuple(order), order)
    return lambda picture: picture[:, :, chosen]


def _grey(picture: Array, red: int, like: str) -> Array:
    """Return the brightness (H, W, 1), with the weights and the rounding of a library."""
    r, g, b = (picture[:, :, channel] for channel in (red, 1, 2 - red))
    if like.startswith("torch"):
        sums = np.float32(0.2989) * r + np.float32(0.587) * g + np.float32(0.114) * b
        return (sums if like == "torch" else np.floor(sums))[:, :, None]
    (of_r, of_g, of_b), bits = ((9798, 19235, 3735), 15) if like == "opencv" else ((19595, 38470, 7471), 16)
    whole = of_r * r.astype(np.int32) + of_g * g.astype(np.int32) + of_b * b.astype(np.int32)
    return np.asarray((whole + (1 << (bits - 1))) >> bits, np.uint8)[:, :, None]


def _step(step: ImageStep, image: Image, before: tuple[int, int]) -> Step:
    if step.op == "crop":
        top, left, rows, columns = step.window(before, image.like)
        return lambda picture: picture[top : top + rows, left : left + columns]
    if step.op == "pad":
        return partial(_pad, step=step, corner=step.border(before))
    after = step.size_after(before, image.like)
    resize = resampler(image.like, step.filter, step.antialias, before, after)
    opaque = ORDERS[image.channels] < 4 or step.filter == "nearest" or before == after
    if image.like.startswith("pil") and not opaque:
        return lambda picture: _unmultiplied(resize(_premultiplied(picture)))
    return resize


def _pad(picture: Array, step: ImageStep, corner: tuple[int, int]) -> Array:
    (height, width), (top, left) = picture.shape[:2], corner
    value = np.array(step.value, np.float32)
    whole = picture.dtype == np.uint8 and (value == np.floor(value)).all()
    channels = max(picture.shape[2], len(value))
    padded = np.empty((*step.size, channels), np.uint8 if whole else np.float32)
    padded[...] = value
    padded[top : top + height, left : left + width] = picture
    return padded


def _premultiplied(picture: Array) -> Array:
    """Return colours times opacity, as PIL resizes them (``rgbA2rgba`` and back in its Convert.c)."""
    alpha = picture[:, :, 3:].astype(np.int32)
    product = picture[:, :, :3] * alpha + 128
    return np.concatenate([((product >> 8) + product) >> 8, alpha], axis=2).astype(np.uint8)


def _unmultiplied(picture: Array) -> Array:
    alpha = picture[:, :, 3:].astype(np.int32)
    colours = picture[:, :, :3].astype(np.int32)
    plain = (alpha == 0) | (alpha == 255)
    divided = np.minimum(255 * colours // np.maximum(alpha, 1), 255)
    return np.concatenate([np.where(plain, colours, divided), alpha], axis=2).astype(np.uint8)


def as_rgb(picture: Array, order: str) -> Array:
    """Return a picture (..., C), or (...) in grey, as (..., 3) for people to look at; one of other axes as it is."""
    if order == "grey":
        grey = picture if picture.ndim > 2 and picture.shape[-1] == 1 else picture[..., None]
        return np.repeat(grey, 3, axis=-1)
    if picture.ndim < 3 or picture.shape[-1] != ORDERS[order]:
        return picture
    return picture[..., [order.index(channel) for channel in "rgb"]]
