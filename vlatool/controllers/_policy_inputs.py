"""Messages to the values that a policy takes: frames by encoding, elements by name."""

from __future__ import annotations

import io
import math
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.controllers._policy_map import FRAMES, IMAGE, InputMap
from vlatool.errors import BusError, require
from vlatool.messages import Message, pixels
from vlatool.messages.joints import joint_values
from vlatool.messages.sensor_msgs import CompressedImage, Image, JointState

Array = NDArray[Any]
GREY = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in grey (ITU-R BT.601)."""


def value_of(entry: InputMap, message: Message) -> Array:
    """Return the value of an input: uint8 (H, W, C) or (H, W, 1) of a camera, float32 (N,) of a vector.

    Raises:
        BusError: for a message that holds no such value.
        MissingExtra: for a compressed image without Pillow.
    """
    if entry.kind in (IMAGE, FRAMES):
        return _frame(message, entry.channels)
    return _vector(entry, message)


def _frame(message: Message, channels: str) -> Array:
    if isinstance(message, CompressedImage):
        rgb = _decoded(message)
    elif isinstance(message, Image):
        rgb = pixels.rgb(message)
    else:
        raise BusError(f"A camera that sends {type(message).TYPE}.", "map a topic of images")
    if channels == "grey":
        return np.round(rgb.astype(np.float32) @ GREY).astype(np.uint8)[:, :, None]
    ordered = rgb[:, :, ::-1] if channels.startswith("bgr") else rgb
    if channels.endswith("a"):
        ordered = np.concatenate([ordered, np.full((*rgb.shape[:2], 1), 255, np.uint8)], axis=2)
    return np.ascontiguousarray(ordered)


def _decoded(message: CompressedImage) -> Array:
    """Return a compressed image as RGB, uint8 (H, W, 3)."""
    pillow: Any = require("PIL.Image", "video")
    try:
        with pillow.open(io.BytesIO(np.asarray(message.data).tobytes()), formats=("JPEG", "PNG")) as picture:
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError, pillow.DecompressionBombError) as error:
        raise BusError(f"A compressed image cannot be read: {str(error)[:80]}.", "check the camera's driver") from None


def _vector(entry: InputMap, message: Message) -> Array:
    if isinstance(message, JointState):
        quantities = {quantity for _, quantity in entry.paths}
        joints = {quantity: [joint for joint, kind in entry.paths if kind == quantity] for quantity in quantities}
        read = {quantity: iter(joint_values(message, names, quantity)) for quantity, names in joints.items()}
        values = [float(next(read[quantity])) for _, quantity in entry.paths]
    else:
        values = [_at(message, path) for path, _ in entry.paths]
    if not all(map(math.isfinite, values)):
        raise BusError(f"'{entry.name}' has a value that is not finite.", "check the sensor")
    return np.array([value * scale for value, scale in zip(values, entry.scales, strict=True)], np.float32)


def _at(message: Message, path: str) -> float:
    """Return a number in a message, such as that of ``pose.pose.position.x`` or ``data.3``."""
    try:
        return float(reduce(_part, path.split("."), message))  # type: ignore[arg-type]
    except (AttributeError, IndexError, TypeError, ValueError):
        raise BusError(f"A {type(message).TYPE} has no number at '{path}'.", "correct the path in the map") from None


def _part(value: Any, name: str) -> Any:
    if name.isdecimal():
        return value[int(name)]
    if name.startswith("_"):
        raise AttributeError(name)
    return getattr(value, name)


def stamp_of(message: Message) -> float | None:
    """Return the stamp of a message in seconds; None where it has none, or zero."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return None if stamp is None or not (stamp.sec or stamp.nanosec) else stamp.seconds
