"""``vlatool inspect --frame``: what the network sees of a camera frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.image import Image, ImageStep
from vlatool.bundle.spec import TensorSpec
from vlatool.data import picture_of, read_frame, write_beside
from vlatool.errors import UsageError, suggest
from vlatool.runtime.image import FrameEncoder, as_rgb


def show_frame(bundle: Bundle, frame: str, output: Path | None, *, force: bool) -> list[str]:
    """Return lines on what the network sees of a frame; write a picture of both.

    Args:
        frame: ``[INPUT=]FILE``; the input may be left out where one alone is an image.
        output: PNG to write, if any.

    Raises:
        UsageError: when no input is an image, or it is not said which.
        DataError: when the frame cannot be read, or is none that the input takes.
        OutputError: when the picture exists, and is not to be replaced.
    """
    tensor, image, file = _input_of(bundle, frame)
    raw = read_frame(Path(file), image.frame)
    encoded = FrameEncoder(tensor, image)(raw)
    lines = [
        f"  frame      {file}: {_axes(raw)} {image.frame}",
        f"  sees       {tensor.name}: {encoded.dtype} {_axes(encoded)}, {encoded.min():.6g} to {encoded.max():.6g}, "
        f"mean of {_means(image, encoded)}",
    ]
    if output:
        write_beside(output, as_rgb(raw, image.frame), picture_of(tensor, image, encoded), force=force)
        lines.append(f"  picture    {output}: the frame, and what the network sees")
    return lines


def _input_of(bundle: Bundle, frame: str) -> tuple[TensorSpec, Image, str]:
    """Return the input that a frame is for, and the name of its file."""
    images = {tensor.name: (tensor, tensor.image) for tensor in bundle.manifest.spec.inputs if tensor.image}
    name, _, file = frame.partition("=")
    if name not in images:
        name, file = next(iter(images)) if len(images) == 1 else "", frame
    if not name:
        raise UsageError(
            f"--frame {frame}: {bundle.path} has {len(images)} inputs that are images; {suggest(name, images)}.",
            "name one: --frame INPUT=FILE" if images else "give an input an image in policy.yaml, and export it again",
        )
    return *images[name], file


def _axes(array: NDArray[Any]) -> str:
    return "x".join(map(str, array.shape))


def _means(image: Image, encoded: NDArray[Any]) -> str:
    """Return the mean of each channel, by its letter."""
    if image.channels == "grey":
        return f"grey {encoded.mean(dtype=np.float64):.6g}"
    axis = encoded.ndim - 3 + image.layout.index("c")
    means = np.moveaxis(encoded, axis, 0).reshape(len(image.channels), -1).mean(1, dtype=np.float64)
    return ", ".join(f"{channel} {mean:.6g}" for channel, mean in zip(image.channels, means, strict=True))


def describe_image(image: Image) -> str:
    """Return in words what becomes of a frame.

    Example:
        >>> describe_image(Image("bgr", steps=(ImageStep("resize", (224, 224)),), range=(-1, 1)))
        'bgr frames to rgb, resize to 224x224 bilinear as pil does, -1 to 1'
    """
    parts = [f"{image.frame} frames" + (f" to {image.channels}" if image.frame != image.channels else "")]
    parts += map(_step, image.steps)
    parts[-1] += f" as {image.like} does" if image.steps else ""
    parts.append(f"{image.range[0]:g} to {image.range[1]:g}")
    parts += [f"{key} {_numbers(values)}" for key, values in (("mean", image.mean), ("std", image.std)) if values]
    return ", ".join(parts)


def _step(step: ImageStep) -> str:
    words = f"{step.op} to {step.size[0]}x{step.size[1]}" if step.size else f"{step.op} to the box {list(step.box)}"
    if step.op == "resize":
        words += f"{'' if step.fit == 'fill' else f' ({step.fit})'} {step.filter}"
        words += " with antialias" if step.antialias else ""
    if step.op == "pad":
        words += f" ({step.side}) with {_numbers(step.value)}"
    return words


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
