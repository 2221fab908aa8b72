"""How a camera frame becomes an input of a network: a part of the spec, computed by ``vlatool.runtime.image``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from vlatool.errors import SpecError, suggest
from vlatool.files.limits import check_limit
from vlatool.files.printable import amount
from vlatool.files.validate import finite_number, integer, known_keys, mapping, sequence, short_repr

ORDERS = {"rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4, "grey": 1}
"""Order of the channels -> how many there are."""
LAYOUTS = {"chw": 3, "hwc": 3, "hw": 2}
LIBRARIES = ("pil", "pil13", "opencv", "torch", "torch_uint8")
FILTERS = ("nearest", "bilinear", "bicubic", "area", "lanczos")
OPERATIONS = {
    "crop": ("size", "box"),
    "resize": ("size", "filter", "fit", "antialias"),
    "pad": ("size", "side", "value"),
}
"""What is done to a picture -> the keys that say how."""
FITS = ("fill", "contain", "cover")
SIDES = ("both", "start", "end")
CAMERA = (480, 640)
"""Height and width of the frames that are drawn for a policy whose spec does not say what its camera gives."""
MAX_STEPS = 16
Size = tuple[int, int]


@dataclass(frozen=True)
class ImageStep:
    """One step from a frame to what the network sees.

    Args:
        op: ``crop``, ``resize`` or ``pad``.
        size: height and width after it, in pixels; of ``resize``, those that ``fit`` is about.
        box: of ``crop``: top, left, height and width in pixels; the middle of ``size`` when it is left out.
        filter: of ``resize``: ``nearest``, ``bilinear``, ``bicubic``, ``area`` or ``lanczos`` (PIL).
        fit: of ``resize``: ``fill`` (exactly ``size``), ``contain`` (the largest with the frame's aspect that lies
            within) or ``cover`` (the smallest that covers it).
        antialias: of ``resize`` as torch does it: filters that grow with the scale; PIL's always do, OpenCV's never.
        side: of ``pad``: where the border goes: ``both`` (the smaller half above and left), ``start`` (above and left)
            or ``end`` (below and right).
        value: of ``pad``: the colour of the border, 0 to 255, one number or one for each channel of the network.
    """

    op: str
    size: tuple[int, ...] = ()
    box: tuple[int, ...] = ()
    filter: str = "bilinear"
    fit: str = "fill"
    antialias: bool = False
    side: str = "both"
    value: tuple[float, ...] = (0.0,)

    def __post_init__(self) -> None:
        _one_of(self.op, OPERATIONS, "A step of 'image' has the op")
        where = f"A step of 'image', {self.op},"
        for field in fields(self):
            if field.name not in ("op", *OPERATIONS[self.op]) and getattr(self, field.name) != field.default:
                raise SpecError(
                    f"{where} has '{field.name}', which belongs to another; {self.op} has: "
                    f"{', '.join(OPERATIONS[self.op])}."
                )
        _one_of(self.filter, FILTERS, f"{where} has the filter")
        _one_of(self.fit, FITS, f"{where} has the fit")
        _one_of(self.side, SIDES, f"{where} has the side")
        if not isinstance(self.antialias, bool):
            raise SpecError(f"{where} has antialias {short_repr(self.antialias)}; it must be true or false.")
        if bool(self.size) == bool(self.box):
            wanted = "either 'size' or 'box'" if self.op == "crop" else "'size'"
            raise SpecError(f"{where} needs {wanted}: [height, width] (box: [top, left, height, width]).")
        _pixels(self.box or self.size, 4 if self.box else 2, where)
        object.__setattr__(self, "value", _numbers(self.value, f"{where} has a value which", (1, 3, 4)))
        if not all(0 <= number <= 255 for number in self.value):
            raise SpecError(f"{where} has the value {short_repr(self.value)}; a colour is 0 to 255.")

    def size_after(self, before: Size, like: str) -> Size:
        """Return height and width of the picture after this step.

        Raises:
            ValueError: with a sentence, when it is impossible.
        """
        height, width = before
        if self.op == "crop":
            top, left, rows, columns = self.window(before, like)
            if top < 0 or left < 0 or top + rows > height or left + columns > width:
                asked = f"the box {list(self.box)}" if self.box else f"{rows}x{columns}"
                raise ValueError(f"crop takes {asked} out of {height}x{width}")
            return rows, columns
        rows, columns = self.size
        if self.op == "pad":
            if rows < height or columns < width:
                raise ValueError(f"pad makes {rows}x{columns} of {height}x{width}, which is larger")
            return rows, columns
        return self._fitted(before) if self.fit != "fill" else (rows, columns)

    def _fitted(self, before: Size) -> Size:
        """Size that keeps the aspect, rounded as openpi (contain) and torchvision (cover) round it."""
        (height, width), (rows, columns) = before, self.size
        if self.fit == "contain":
            ratio = max(width / columns, height / rows)
            return max(1, int(height / ratio)), max(1, int(width / ratio))
        if height * columns <= width * rows:
            return rows, max(columns, int(rows * width / height))
        return max(rows, int(columns * height / width)), columns

    def window(self, before: Size, like: str) -> tuple[int, int, int, int]:
        """Return top, left, height and width of what a crop leaves; half a pixel is rounded as the library does."""
        if self.box:
            top, left, rows, columns = self.box
            return top, left, rows, columns
        rows, columns = self.size
        rest = before[0] - rows, before[1] - columns
        top, left = (round(each / 2) if like.startswith("torch") else each // 2 for each in rest)
        return top, left, rows, columns

    def border(self, before: Size) -> Size:
        """Return how many rows and columns of a padded picture lie above and left of it."""
        rest = self.size[0] - before[0], self.size[1] - before[1]
        share = {"both": 2, "start": 1}.get(self.side)
        return (rest[0] // share, rest[1] // share) if share else (0, 0)

    @classmethod
    def from_dict(cls, data: Any) -> ImageStep:
        """Build from a mapping.

        Raises:
            SpecError: for an unknown key or an impossible value.
        """
        values = _known(cls, data, "A step of 'image'")
        if "op" not in values:
            raise SpecError(f"A step of 'image' needs 'op'; {suggest('', OPERATIONS)}.")
        return cls(**values)


@dataclass(frozen=True)
class Image:
    """What a camera frame becomes before the network sees it: colours, then the steps in order, then the numbers.

    A frame is uint8, (H, W, C) or, in grey, (H, W), of any size from which the steps make what the input declares.

    Args:
        frame: order of the channels as the camera gives them: ``rgb``, ``bgr``, ``rgba``, ``bgra`` or ``grey``.
        channels: order of the channels as the network takes them, the same words.
        layout: order of the last axes of the input: ``chw``, ``hwc`` or, in grey, ``hw``; axes of 1 may stand before.
        like: whose results are meant: ``pil`` (before version 13), ``pil13``, ``opencv``, ``torch`` (of floats) or
            ``torch_uint8`` (as torchvision calls torch for uint8 images).
        steps: crop, resize and pad, in the order in which they are done; none for a frame that has the size already.
        range: what 0 and 255 become: ``[0, 255]``, ``[0, 1]``, ``[-1, 1]``.
        mean: subtracted after that, one number or one for each channel of the network.
        std: divided by after that, in the same way.
        camera: height and width of the frames of the camera, for synthetic observations; 480 x 640 when left out.
    """

    frame: str = "rgb"
    channels: str = "rgb"
    layout: str = "chw"
    like: str = "pil"
    steps: tuple[ImageStep, ...] = ()
    range: tuple[float, ...] = (0.0, 255.0)
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    camera: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _one_of(self.frame, ORDERS, "'image' has the frame")
        _one_of(self.channels, ORDERS, "'image' has the channels")
        _one_of(self.layout, LAYOUTS, "'image' has the layout")
        _one_of(self.like, LIBRARIES, "'image' has like")
        if ORDERS[self.channels] == 4 and ORDERS[self.frame] != 4:
            raise SpecError(
                f"'image' makes {self.channels} of {self.frame} frames; those have no alpha channel.",
                "let the camera give rgba or bgra, or the network take rgb",
            )
        if self.layout == "hw" and self.channels != "grey":
            raise SpecError(f"'image' has the layout hw for {self.channels}; it is for grey.", "write chw or hwc")
        if len(self.steps) > MAX_STEPS:
            raise SpecError(f"'image' has {len(self.steps)} steps; allowed: up to {MAX_STEPS}.")
        for step in self.steps:
            self._check_step(step)
        self._check_numbers()
        if self.camera:
            _pixels(self.camera, 2, "The camera of 'image'")

    def _check_step(self, step: Any) -> None:
        if not isinstance(step, ImageStep):
            raise SpecError(f"'steps' of 'image' must be a list of mappings; got {short_repr(step)}.")
        if step.filter == "lanczos" and not self.like.startswith("pil"):
            raise SpecError(f"'image' has the filter lanczos like {self.like}; it is PIL's alone.", "write like: pil")
        if step.antialias and (self.like == "opencv" or step.filter in ("nearest", "area")):
            raise SpecError(
                f"'image' has antialias for the filter {step.filter} like {self.like}, which has none.",
                "leave it out; OpenCV shrinks without steps in the picture by the filter area",
            )
        if len(step.value) not in (1, ORDERS[self.channels]):
            raise SpecError(
                f"'image' pads {self.channels} with {amount(len(step.value), 'number')}; give one, or one a channel."
            )
        if self.like != "torch" and any(number % 1 for number in step.value):
            raise SpecError(
                f"'image' pads with {short_repr(step.value)} like {self.like}, which has whole numbers.",
                "round it, or write like: torch",
            )

    def _check_numbers(self) -> None:
        low, high = _numbers(self.range, "The range of 'image'", (2,))
        if low >= high:
            raise SpecError(f"The range of 'image' is {short_repr(self.range)}; the first number must be the lower.")
        object.__setattr__(self, "range", (low, high))
        for name in ("mean", "std"):
            numbers = _numbers(getattr(self, name), f"The {name} of 'image'", (0, 1, ORDERS[self.channels]))
            object.__setattr__(self, name, numbers)
        if not all(number > 0 for number in self.std):
            raise SpecError(f"The std of 'image' is {short_repr(self.std)}; it must be above 0.")

    def size_after(self, frame: Size) -> Size:
        """Return height and width of what a frame of a size becomes.

        Raises:
            ValueError: with a sentence, when a step is impossible.
        """
        for number, step in enumerate(self.steps, 1):
            try:
                frame = step.size_after(frame, self.like)
            except ValueError as error:
                raise ValueError(f"step {number} of its image, {error}") from None
        return frame

    def frame_shape(self, shape: tuple[int | str, ...]) -> tuple[int, ...]:
        """Return the shape of a frame from which the steps make an input: that of the camera, or one that fits.

        Args:
            shape: of the input.

        Raises:
            ValueError: when nothing of those fits.
        """
        sizes = [size for size in (self.camera or CAMERA, self._declared(shape)) if self.makes(size, shape)]
        if not sizes or (self.camera and sizes[0] != self.camera):
            raise ValueError("no frame fits")
        channels = ORDERS[self.frame]
        return (*sizes[0], channels) if channels > 1 else (*sizes[0],)

    def _declared(self, shape: tuple[int | str, ...]) -> Size:
        """Return height and width as an input declares them; of a free one, that of the camera."""
        axes = shape[-LAYOUTS[self.layout] :]
        sides = (axes[self.layout.index(axis)] for axis in "hw")
        height, width = (side if isinstance(side, int) else CAMERA[at] for at, side in enumerate(sides))
        return height, width

    def makes(self, frame: tuple[int, ...], shape: tuple[int | str, ...]) -> bool:
        """Return whether frames of a height and width become what an input declares."""
        try:
            size = self.size_after((frame[0], frame[1]))
        except ValueError:
            return False
        axes = shape[-LAYOUTS[self.layout] :]
        sides = [axes[self.layout.index(axis)] for axis in "hw"]
        return all(isinstance(side, str) or side == got for side, got in zip(sides, size, strict=True))

    def check_input(self, name: str, shape: tuple[int | str, ...], dtype: str) -> None:
        """Check that an input can be what frames become.

        Raises:
            SpecError: for another number of axes or channels, a size that no frame leads to, or a dtype that does not
                hold the numbers.
        """
        axes = LAYOUTS[self.layout]
        if len(shape) < axes or any(axis != 1 for axis in shape[:-axes]):
            raise SpecError(
                f"'{name}' has the shape {short_repr(shape)}; an image of the layout {self.layout} has {axes} axes, "
                "and before them only axes of 1."
            )
        wanted = ORDERS[self.channels]
        got = shape[len(shape) - axes + self.layout.index("c")] if axes == 3 else 1
        if got != wanted:
            raise SpecError(
                f"'{name}' has {short_repr(got)} channels in its shape {short_repr(shape)}, layout {self.layout}; "
                f"{self.channels} has {wanted}.",
                "correct the shape, 'layout' or 'channels'",
            )
        plain = self.range == (0.0, 255.0) and not self.mean and not self.std
        if dtype not in ("float32", "float16") and not (dtype == "uint8" and plain and self.like != "torch"):
            raise SpecError(
                f"'{name}' is {dtype} with an image; allowed: float32, float16, and uint8 for whole numbers 0 to 255.",
                "a range, mean, std and the results of 'like: torch' are floats",
            )
        try:
            self.frame_shape(shape)
        except ValueError:
            raise SpecError(f"'{name}' has the shape {short_repr(shape)}; {self._reason()}.", self._fix()) from None

    def _reason(self) -> str:
        frame = self.camera or CAMERA
        words = f"a frame of {frame[0]}x{frame[1]}"
        try:
            size = self.size_after((frame[0], frame[1]))
        except ValueError as error:
            return f"of {words} nothing can be made: {error}"
        return f"its image makes {size[0]}x{size[1]} of {words}"

    def _fix(self) -> str:
        if self.camera:
            return "correct the shape, the steps or 'camera'"
        return "correct the shape or the steps, or say which frames the camera gives: camera: [HEIGHT, WIDTH]"

    @classmethod
    def from_dict(cls, data: Any) -> Image:
        """Build from a mapping as in ``manifest.json`` or ``policy.yaml``.

        Raises:
            SpecError: for an unknown key or an impossible value.
        """
        values = _known(cls, data, "'image'")
        steps = sequence(values.get("steps", ()), "'steps' of 'image'", SpecError)
        return cls(**{**values, "steps": tuple(map(ImageStep.from_dict, steps))})

    def to_dict(self) -> dict[str, Any]:
        """Return a mapping that ``from_dict`` turns back into an equal image."""
        plain = _plain(self)
        if self.steps:
            plain["steps"] = [_plain(step) for step in self.steps]
        return plain


def _known(cls: type, data: Any, where: str) -> dict[str, Any]:
    """Return the values of a mapping, which has known keys alone; lists as tuples."""
    values = mapping(data, where, SpecError)
    known_keys(values, [field.name for field in fields(cls)], where, SpecError)
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def _plain(value: Any) -> dict[str, Any]:
    """Return the fields that differ from their defaults, lists for tuples."""
    items = ((field, getattr(value, field.name)) for field in fields(value))
    return {field.name: list(item) if isinstance(item, tuple) else item for field, item in items
            if item != field.default}  # fmt: skip


def _one_of(value: Any, allowed: Mapping[str, Any] | tuple[str, ...], where: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        hint = suggest(value, allowed) if isinstance(value, str) else "it must be text"
        raise SpecError(f"{where} {short_repr(value)}; {hint}.")


def _pixels(values: Any, count: int, where: str) -> None:
    """Refuse anything but a number of pixels for each of ``count``; the last two are a height and a width."""
    numbers = sequence(values, f"{where} the size", SpecError)
    if len(numbers) != count:
        raise SpecError(f"{where} has {short_repr(values)}; wanted {amount(count, 'number')} of pixels.")
    for at, number in enumerate(numbers):
        integer(number, f"{where} a number of pixels", SpecError, 0 if at < count - 2 else 1)
    check_limit("elements", math.prod(numbers[-2:]), where, SpecError)


def _numbers(values: Any, where: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return numbers as a tuple; one that stands alone is accepted, too."""
    if isinstance(values, int | float) and not isinstance(values, bool):
        values = (values,)
    numbers = tuple(finite_number(each, where, SpecError) for each in sequence(values, where, SpecError))
    if len(numbers) not in counts:
        allowed = " or ".join(map(str, counts))
        raise SpecError(f"{where} has {amount(len(numbers), 'number')}; allowed: {allowed}.")
    return numbers
