"""Random camera frames against PIL, OpenCV and torch: what the runtime makes of them, pixel by pixel, and how fast.

    pip install opencv-python-headless
    python tests/validation/soak/frames.py --frames 10000

Frames are noise, edges and gradients of 64 to 1920 pixels a side, grey, RGB, BGR, RGBA and BGRA, in memory as they come
or as views of any strides; cropped, resized, padded. Prints a line for each library and filter: frames, the share of
pixels that differ, the largest difference in units of 1/255 and the case that has it; then the time of one frame of
640 x 480 to 224 x 224. Exit code 1 when a difference is above 1/255, or one that must be zero is not.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vlatool.bundle.image import ORDERS, Image, ImageStep
from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.image import FrameEncoder

SIDES = (64, 1920)
KINDS = ("nearest", "bilinear", "bicubic", "area", "lanczos")
EQUAL = {*((like, kind) for like in ("pil", "pil13") for kind in KINDS), ("opencv", "nearest"), ("opencv", "bilinear"),
         ("torch", "nearest"), ("torch_uint8", "nearest")}  # fmt: skip
"""Library and filter whose results have the same bits."""
ROUNDING = 1e-3
"""Of 1/255: how far floats that are summed in another order may be apart before they count as different."""
Reference = Callable[[Any, "Case"], Any]


@dataclass(frozen=True)
class Case:
    """One frame, its image, and what is done to it."""

    image: Image
    frame: Any
    shape: tuple[int, ...]


@dataclass
class Tally:
    """What was seen of a library and filter."""

    frames: int = 0
    pixels: int = 0
    different: int = 0
    worst: float = 0.0
    where: str = ""
    libraries: set[str] = field(default_factory=set)

    def add(self, case: Case, got: Any, wanted: Any) -> None:
        distance = np.abs(np.asarray(got, np.float64) - wanted)
        self.frames += 1
        self.pixels += distance.size
        self.different += int((distance > ROUNDING).sum())
        if distance.max() > self.worst:
            self.worst = float(distance.max())
            steps = ", ".join(f"{step.op} {step.box or step.size} {step.fit}" for step in case.image.steps)
            self.where = f"{case.frame.shape} {case.image.frame} to {case.image.channels}: {steps}"


def libraries() -> dict[str, Reference]:
    """Return the libraries that are installed: what ``like`` calls them -> what they make of a frame."""
    found: dict[str, Reference] = {}
    try:
        import PIL
    except ImportError:
        print("without PIL, which is not installed")
    else:
        found["pil13" if int(PIL.__version__.partition(".")[0]) >= 13 else "pil"] = pil
    try:
        import cv2
    except ImportError:
        print("without OpenCV: pip install opencv-python-headless")
    else:
        cv2.setNumThreads(1)
        found["opencv"] = opencv
    try:
        import torch
    except ImportError:
        print("without torch, which is not installed")
    else:
        torch.set_num_threads(1)
        found |= {"torch": torch_floats, "torch_uint8": torch_uint8}
    return found


def pil(frame: Any, case: Case) -> Any:
    """What Pillow makes of a frame, (h, w, C)."""
    from PIL import Image as Pictures

    names = {"nearest": "NEAREST", "bilinear": "BILINEAR", "bicubic": "BICUBIC", "area": "BOX", "lanczos": "LANCZOS"}
    picture = Pictures.fromarray(_rgb(frame, case.image.frame))
    modes = {"grey": "L", "rgba": "RGBA", "bgra": "RGBA"}
    picture = picture.convert(modes.get(case.image.channels, "RGB"))
    for step in case.image.steps:
        width, height = picture.size
        if step.op == "resize":
            rows, columns = step.size_after((height, width), "pil")
            picture = picture.resize((columns, rows), Pictures.Resampling[names[step.filter]])
        elif step.op == "crop":
            top, left, rows, columns = step.window((height, width), "pil")
            picture = picture.crop((left, top, left + columns, top + rows))
        else:
            canvas = Pictures.new(picture.mode, (step.size[1], step.size[0]), _colour(step, picture.mode))
            top, left = step.border((height, width))
            canvas.paste(picture, (left, top))
            picture = canvas
    made = np.asarray(picture)
    return _ordered(made if made.ndim == 3 else made[:, :, None], case.image.channels)


def _colour(step: ImageStep, mode: str) -> Any:
    return int(step.value[0]) if mode == "L" else (int(step.value[0]),) * len(mode)


def opencv(frame: Any, case: Case) -> Any:
    """What OpenCV makes of a frame, (h, w, C)."""
    import cv2

    kinds = {"nearest": cv2.INTER_NEAREST, "bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC,
             "area": cv2.INTER_AREA}  # fmt: skip
    one, other = (word.upper().replace("GREY", "GRAY") for word in (case.image.frame, case.image.channels))
    picture = frame if one == other else cv2.cvtColor(frame, getattr(cv2, f"COLOR_{one}2{other}"))
    for step in case.image.steps:
        size = picture.shape[:2]
        if step.op == "resize":
            picture = cv2.resize(picture, step.size_after(size, "opencv")[::-1], interpolation=kinds[step.filter])
        elif step.op == "crop":
            top, left, rows, columns = step.window(size, "opencv")
            picture = np.ascontiguousarray(picture[top : top + rows, left : left + columns])
        else:
            (top, left), value = step.border(size), (step.value[0],) * 4
            below, right = step.size[0] - size[0] - top, step.size[1] - size[1] - left
            picture = cv2.copyMakeBorder(picture, top, below, left, right, cv2.BORDER_CONSTANT, value=value)
    return picture if picture.ndim == 3 else picture[:, :, None]


def torch_floats(frame: Any, case: Case) -> Any:
    """What torch makes of a frame in floats of 0 to 255, (h, w, C)."""
    return _torch(frame, case, whole=False)


def torch_uint8(frame: Any, case: Case) -> Any:
    """What torch makes of a frame in uint8, as torchvision calls it, (h, w, C)."""
    return _torch(frame, case, whole=True)


def _torch(frame: Any, case: Case, *, whole: bool) -> Any:
    import torch

    pixels = torch.from_numpy(_rgb(frame, case.image.frame)).reshape(*frame.shape[:2], -1).permute(2, 0, 1)[None]
    channels = ORDERS[case.image.channels]
    pixels = pixels[:, :channels] if channels > 1 else pixels[:, :3]
    if channels == 1 and pixels.shape[1] == 3:
        pixels = sum(weight * pixels[:, at : at + 1].float() for at, weight in enumerate((0.2989, 0.587, 0.114)))
        pixels = pixels.to(torch.uint8) if whole else pixels
    pixels = pixels if whole else pixels.float()
    for step in case.image.steps:
        size = (int(pixels.shape[2]), int(pixels.shape[3]))
        if step.op == "resize":
            pixels = _interpolated(pixels, step, step.size_after(size, "torch"))
        elif step.op == "crop":
            top, left, rows, columns = step.window(size, "torch")
            pixels = pixels[:, :, top : top + rows, left : left + columns]
        else:
            top, left = step.border(size)
            edges = (left, step.size[1] - size[1] - left, top, step.size[0] - size[0] - top)
            pixels = torch.nn.functional.pad(pixels, edges, value=step.value[0])
    made = pixels[0].permute(1, 2, 0).numpy()
    made = np.repeat(made, channels, 2) if made.shape[2] == 1 else made
    return _ordered(made, case.image.channels)


def _interpolated(pixels: Any, step: ImageStep, size: tuple[int, int]) -> Any:
    import torch

    resize = torch.nn.functional.interpolate
    if step.filter in ("nearest", "area"):
        made = resize(pixels.float(), size=size, mode=step.filter)
        return made.round().clamp(0, 255).to(pixels.dtype) if pixels.dtype == torch.uint8 else made
    return resize(pixels, size=size, mode=step.filter, align_corners=False, antialias=step.antialias)


def _rgb(frame: Any, order: str) -> Any:
    """A frame as RGB or RGBA, grey as it is."""
    if order == "grey":
        return np.ascontiguousarray(frame)
    return np.ascontiguousarray(frame[:, :, [order.index(channel) for channel in "rgba"[: len(order)]]])


def _ordered(picture: Any, channels: str) -> Any:
    """A picture of RGB or RGBA in the order of a network."""
    if channels == "grey":
        return picture
    return picture[:, :, ["rgba".index(channel) for channel in channels]]


def draw(like: str, random: np.random.Generator) -> Case:
    """Draw a frame, its image, and the input that it becomes.

    A resized picture has two pixels a side or more: with one, torch 2.13 gives the first row or column everywhere.
    """
    order = str(random.choice(list(ORDERS)))
    channels = str(random.choice(["rgb", "bgr", "grey", *(("rgba",) if len(order) == 4 and order != "grey" else ())]))
    height, width = (int(np.exp(random.uniform(*np.log(SIDES)))) for _ in range(2))
    while True:
        steps = _steps(like, random)
        image = Image(order, channels, "hwc", like, steps, camera=(height, width))
        try:
            size = image.size_after((height, width))
            resized = replace(image, steps=steps[: 1 + (steps[0].op == "crop")]).size_after((height, width))
            if 1 in resized:
                continue
        except ValueError:  # a crop that is larger than the frame
            continue
        return Case(image, _frame(random, height, width, ORDERS[order]), (1, *size, ORDERS[channels]))


def _steps(like: str, random: np.random.Generator) -> tuple[ImageStep, ...]:
    kinds = KINDS if like.startswith("pil") else KINDS[:4]
    kind = str(random.choice(kinds))
    smooth = like.startswith("torch") and kind in ("bilinear", "bicubic")
    antialias = bool(smooth and random.integers(2))
    rows, columns = (int(side) for side in random.integers(16, 449, 2))
    fit = str(random.choice(["fill", "contain", "cover"]))
    resize = ImageStep("resize", (rows, columns), filter=kind, fit=fit, antialias=antialias)
    value = (float(random.integers(256)),)
    after = {
        "fill": (), "contain": (ImageStep("pad", (rows, columns), side=str(random.choice(["both", "start", "end"])),
                                          value=value),),
        "cover": (ImageStep("crop", (rows, columns)),),
    }[fit]  # fmt: skip
    before = (ImageStep("crop", box=(3, 5, 48, 40)),) if not random.integers(6) else ()
    return (*before, resize, *after)


def _frame(random: np.random.Generator, height: int, width: int, channels: int) -> Any:
    """Noise, edges or a gradient; in one of three, a view with other strides."""
    kind = random.integers(3)
    pixels = random.integers(0, 256, (height, width, channels), np.uint8)
    if kind == 1:
        pixels = ((pixels > 127) * np.uint8(255)).astype(np.uint8)
    if kind == 2:
        ramp = np.linspace(0, 255, height)[:, None, None] + np.linspace(0, 255, width)[:, None]
        pixels = np.broadcast_to(ramp / 2, pixels.shape).astype(np.uint8)
    view = random.integers(6)
    if view == 0:
        pixels = np.ascontiguousarray(pixels[::-1])[::-1]
    if view == 1:
        pixels = np.asfortranarray(pixels)
    return pixels[:, :, 0] if channels == 1 else pixels


def encoder(case: Case) -> FrameEncoder:
    """Return what the runtime makes an input with."""
    dtype = "float32" if case.image.like == "torch" else "uint8"
    return FrameEncoder(TensorSpec("frame", case.shape, dtype, image=case.image), case.image)


def compare(count: int, seed: int, found: dict[str, Reference]) -> dict[tuple[str, str, bool], Tally]:
    """Hold ``count`` frames against the libraries in turn."""
    random, tallies = np.random.default_rng(seed), dict[tuple[str, str, bool], Tally]()
    names = list(found)
    for number in range(count):
        like = names[number % len(names)]
        case = draw(like, random)
        got = encoder(case)(case.frame)[0]
        wanted = found[like](case.frame, case)
        if wanted.shape[2] == 1:
            wanted = np.broadcast_to(wanted, got.shape)
        step = next(step for step in case.image.steps if step.op == "resize")
        tallies.setdefault((like, step.filter, step.antialias), Tally()).add(case, got, wanted)
    return tallies


def timings(found: dict[str, Reference], rounds: int) -> None:
    """Print the time of one frame, 640 x 480 to (3, 224, 224) with mean and std."""
    frame = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    for like in found:
        image = Image("bgr", "rgb", "chw", like, (ImageStep("resize", (224, 224)),), (0.0, 1.0), (0.5,), (0.5,))
        encode = FrameEncoder(TensorSpec("frame", (1, 3, 224, 224), image=image), image)
        encode(frame)
        taken = []
        for _ in range(rounds):
            start, began = time.perf_counter(), time.thread_time()
            encode(frame)
            taken.append((time.thread_time() - began, time.perf_counter() - start))
        own, wall = ([1e3 * each for each in column] for column in zip(*taken, strict=True))
        print(f"640x480 to 224x224 like {like:12} {np.median(own):5.2f} ms of one core (median of {rounds}), "
              f"least {min(wall):.2f} ms")  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run the trials."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=200, help="frames that are timed")
    chosen = parser.parse_args(arguments)
    found = libraries()
    wrong = 0
    for (like, kind, antialias), tally in sorted(compare(chosen.frames, chosen.seed, found).items()):
        equal = (like, kind) in EQUAL
        bad = tally.worst > 1.001 or (equal and tally.different > 0)
        wrong += bad
        print(f"{like:12} {kind:9}{' antialias' if antialias else '':10} {tally.frames:5} frames, "
              f"{tally.different / tally.pixels:8.4%} of {tally.pixels:.2g} pixels differ, largest {tally.worst:.4f} "
              f"/ 255{' WRONG ' + tally.where if bad else ''}", flush=True)  # fmt: skip
    timings(found, chosen.rounds)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
