"""Conversions between the values of a robot and those of a network, computed by ``vlatool.runtime.converter``.

An input passes its list from first to last, the action from last to first.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from vlatool.errors import SpecError, suggest
from vlatool.files.messages import to_json
from vlatool.files.printable import amount
from vlatool.files.validate import finite_number, integer, known_keys, mapping, sequence, short_repr, text

OPERATIONS: dict[str, tuple[str, ...]] = {
    "relative": ("parts", "to", "state", "successive", "pose", "frame"),
    "rotation": ("parts", "robot", "network", "hemisphere"),
    "scale": ("parts", "factor", "offset"),
    "range": ("parts", "robot", "network"),
    "clip": ("parts", "low", "high"),
    "binarise": ("parts", "threshold", "below", "above", "equal"),
    "linkage": ("parts", "arm_length", "horn_radius"),
    "normalisation": (),
}
"""What is done to a vector -> the keys that say how."""
OUTPUTS_ALONE = ("relative",)
PAIRS = ("xy", "xz", "yx", "yz", "zx", "zy")
"""Two columns or rows of a matrix; the first and second one (``xy``) where a form does not say which."""
_SIDES = tuple(f"6d_{side}{how}" for side in ("columns", "rows") for how in ("", "_interleaved"))
_EULER = tuple("".join(axes) for axes in itertools.product("xyz", repeat=3) if axes[0] != axes[1] != axes[2])
ROTATIONS = {
    "axis_angle": 3, "quaternion_xyzw": 4, "quaternion_wxyz": 4, "matrix": 9,
    **{f"{form}{pair}": 6 for form in _SIDES for pair in ("", *(f"_{pair}" for pair in PAIRS))},
    **{f"euler_{order}": 3 for axes in _EULER for order in (axes, axes.upper())},
}  # fmt: skip
"""Form of a rotation -> elements. Angles are in rad. ``euler_xyz`` turns about fixed axes, ``euler_XYZ`` about those
that turn along (as SciPy calls them); a matrix is written row by row. ``6d_columns`` is the first column and then the
second, ``6d_rows`` the first row and then the second, ``_interleaved`` their elements by turns; ``6d_rows_yz`` others.
"""
FRAMES = ("tool", "base")
HEMISPHERES = ("positive", "negative", "keep")
MAX_CONVERSIONS = 32
LARGEST = 1e30
"""Largest number of a step, and the inverse of the smallest factor: float32 holds no more than 3e38."""
Span = tuple[int, int]
Selector = str | int | tuple[int, ...]
"""A name of a part or label, the place of an element, or [start, stop)."""


@dataclass(frozen=True)
class Conversion:
    """One step between the values of the robot and those of the network.

    Args:
        op: ``relative``: the network gives differences from what an input holds at the time of inference.
            ``rotation``: the same rotation in another form, of ``ROTATIONS``.
            ``scale``: the network has robot x factor + offset: signs, units, zeros of joints.
            ``range``: ``robot`` and ``network`` are the same two places of one scale, in any order.
            ``clip``: not below ``low`` and not above ``high``, on both ways.
            ``binarise``: ``above`` for what is above the threshold, ``below`` for what is not; it has no way back.
            ``linkage``: the robot has the position of a gripper's fingers in m, the network the angle of the horn that
            moves them by an arm, in rad: angle = arcsin((r^2 + x^2 - l^2) / (2 r x)), as on ALOHA (Interbotix).
            ``normalisation`` stands where the statistics of the tensor are applied: after the last step if it is left
            out; steps behind it are done to normalised values.
        parts: what the step is done to: names of parts or labels, places of elements, or [start, stop] (stop is not
            part of it); the whole vector when left out. Places count the elements as they are before the step.
        to: of ``relative``: name of the input that holds the state, in the units of the action; of a history, the
            newest moment.
        state: of ``relative``: the parts of that input, one for each of ``parts``; the same ones when left out.
        successive: of ``relative``: whether each action is a difference from the one before it in the chunk, and the
            first from the state; otherwise all are differences from the state.
        pose: of ``relative``: form of a rotation: each part is such a rotation, or three elements of a position and
            then the rotation, and is composed with that of the state instead of being added.
        frame: of ``relative`` with a pose: ``tool``: differences are in the frame of the state (state x difference, as
            GR00T has it), ``base``: in the frame of the base (difference x state, positions are added).
        robot: of ``rotation``: the form that the robot gives or gets; of ``range``: two numbers.
        network: of ``rotation``: the form that the network takes or gives; of ``range``: what they are there.
        hemisphere: of ``rotation``: sign of w of quaternions that result, and of those that axis and angle result
            from: ``positive`` (angles up to pi), ``negative`` (beyond) or ``keep``.
        factor: of ``scale``: not 0; one number, or one for each element of the parts, in their order.
        offset: of ``scale``: in the same way.
        low: of ``clip``: in the same way, none for no bound.
        high: of ``clip``: in the same way.
        threshold: of ``binarise``.
        below: of ``binarise``.
        above: of ``binarise``.
        equal: of ``binarise``: what becomes of the threshold itself; ``below`` when left out.
        arm_length: of ``linkage``: l in m.
        horn_radius: of ``linkage``: r in m.
    """

    op: str
    parts: tuple[Selector, ...] = ()
    to: str = ""
    state: tuple[Selector, ...] = ()
    successive: bool = False
    pose: str = ""
    frame: str = "tool"
    robot: str | tuple[float, ...] = ""
    network: str | tuple[float, ...] = ""
    hemisphere: str = "positive"
    factor: tuple[float, ...] = (1.0,)
    offset: tuple[float, ...] = (0.0,)
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    threshold: float = 0.0
    below: float = -1.0
    above: float = 1.0
    equal: float | None = None
    arm_length: float = 0.0
    horn_radius: float = 0.0

    def __post_init__(self) -> None:
        _one_of(self.op, OPERATIONS, "A step of 'convert' has the op")
        for field in fields(self):
            if field.name not in ("op", *OPERATIONS[self.op]) and getattr(self, field.name) != field.default:
                allowed = ", ".join(OPERATIONS[self.op]) or "no key but 'op'"
                raise SpecError(f"{self.where} has '{field.name}', which belongs to another; {self.op} has: {allowed}.")
        for name in ("parts", "state"):
            object.__setattr__(self, name, _selectors(getattr(self, name), f"{self.where} has {name}, of which one"))
        check = getattr(self, f"_check_{self.op}", None)
        if check is not None:
            check()

    @property
    def where(self) -> str:
        """Beginning of a message about this step."""
        return f"A step of 'convert', {self.op},"

    def _check_relative(self) -> None:
        text(self.to, f"{self.where} needs 'to', the name of an input; it", SpecError, empty=False)
        if not isinstance(self.successive, bool):
            raise SpecError(f"{self.where} has successive {short_repr(self.successive)}; it must be true or false.")
        if self.pose or self.frame != "tool":
            _one_of(self.pose, ROTATIONS, f"{self.where} has the pose")
        _one_of(self.frame, FRAMES, f"{self.where} has the frame")
        if self.state and len(self.state) != len(self.parts):
            raise SpecError(
                f"{self.where} has {amount(len(self.parts), 'part')} and {amount(len(self.state), 'part')} of the "
                "state.",
                "name one part in 'state' for each of 'parts'",
            )

    def _check_rotation(self) -> None:
        for side in ("robot", "network"):
            _one_of(getattr(self, side), ROTATIONS, f"{self.where} has on the side of the {side} the form")
        _one_of(self.hemisphere, HEMISPHERES, f"{self.where} has the hemisphere")
        if not self.parts:
            raise SpecError(f"{self.where} needs 'parts': the rotations in the vector.")

    def _check_scale(self) -> None:
        self._keep_numbers("factor", "offset")
        if not self.factor or not self.offset or min(map(abs, self.factor)) < 1 / LARGEST:
            got = f"the factor {short_repr(self.factor)} and the offset {short_repr(self.offset)}"
            raise SpecError(f"{self.where} has {got}; wanted: numbers, and no factor of 0, which has no way back.")

    def _check_range(self) -> None:
        self._keep_numbers("robot", "network")
        for side in ("robot", "network"):
            values = getattr(self, side)
            if len(values) != 2 or abs(values[0] - values[1]) < 1 / LARGEST:
                raise SpecError(f"{self.where} has {side} {short_repr(values)}; wanted: two numbers that differ.")

    def _check_clip(self) -> None:
        self._keep_numbers("low", "high")
        bounds = [(low, high) for low in self.low for high in self.high] if 1 in (len(self.low), len(self.high)) else (
            zip(self.low, self.high, strict=False))  # fmt: skip
        if not (self.low or self.high) or any(low > high for low, high in bounds):
            got = f"low {short_repr(self.low)} and high {short_repr(self.high)}"
            raise SpecError(f"{self.where} has {got}; wanted: one of them at least, the lower one as 'low'.")

    def _check_binarise(self) -> None:
        for name in ("threshold", "below", "above"):
            object.__setattr__(self, name, _number(getattr(self, name), f"{self.where} has {name}, which"))
        if self.equal is not None:
            object.__setattr__(self, "equal", _number(self.equal, f"{self.where} has equal, which"))

    def _check_linkage(self) -> None:
        for name in ("arm_length", "horn_radius"):
            if _number(getattr(self, name), f"{self.where} has {name}, which") <= 0:
                raise SpecError(f"{self.where} needs {name} in m, above 0; got {short_repr(getattr(self, name))}.")

    def _keep_numbers(self, *names: str) -> None:
        """Make tuples of numbers of fields; one number that stands alone is accepted, too."""
        for name in names:
            value = getattr(self, name)
            listed = value if isinstance(value, list | tuple) else (value,)
            numbers = tuple(_number(each, f"{self.where} has {name}, of which one") for each in listed)
            object.__setattr__(self, name, numbers)

    @property
    def growth(self) -> int:
        """Elements that each part has more on the side of the network than on that of the robot."""
        if self.op != "rotation":
            return 0
        return ROTATIONS[str(self.network)] - ROTATIONS[str(self.robot)]

    @property
    def of_outputs_alone(self) -> bool:
        """Whether no input may have it."""
        return self.op in OUTPUTS_ALONE

    def check_spans(self, spans: Iterable[Span]) -> None:
        """Check the places of the parts on the side of the robot.

        Raises:
            SpecError: for parts that overlap, or are not as wide as a rotation.
        """
        ordered = sorted(spans)
        for (_, stop), (start, _) in itertools.pairwise(ordered):
            if start < stop:
                raise SpecError(f"{self.where} has parts that overlap; each element may be converted once.")
        for start, stop in ordered if self.op == "rotation" else ():
            if stop - start != ROTATIONS[str(self.robot)]:
                raise SpecError(
                    f"{self.where} is done to {amount(stop - start, 'element')}, [{start}, {stop}); {self.robot} has "
                    f"{ROTATIONS[str(self.robot)]}.",
                    "name the part of the robot's vector that is the rotation alone",
                )
        for start, stop in ordered if self.pose else ():
            if stop - start - ROTATIONS[self.pose] not in (0, 3):
                raise SpecError(
                    f"{self.where} has a pose of {amount(stop - start, 'element')}, [{start}, {stop}); {self.pose} has "
                    f"{ROTATIONS[self.pose]}, and 3 more with a position."
                )
        elements = sum(stop - start for start, stop in ordered)
        for name in ("factor", "offset", "low", "high"):
            if len(getattr(self, name)) not in (0, 1, elements):
                raise SpecError(
                    f"{self.where} has {len(getattr(self, name))} numbers as {name}, for "
                    f"{amount(elements, 'element')}.",
                    "give one number, or one for each element of 'parts', in their order",
                )

    @classmethod
    def from_dict(cls, data: Any) -> Conversion:
        """Build from a mapping as in ``manifest.json`` or ``policy.yaml``.

        Raises:
            SpecError: for an unknown key or an impossible value.
        """
        values = mapping(data, "A step of 'convert'", SpecError)
        if "op" not in values:
            raise SpecError(f"A step of 'convert' needs 'op'; {suggest('', OPERATIONS)}.")
        known_keys(values, [field.name for field in fields(cls)], f"A step of 'convert', {values['op']},", SpecError)
        plain: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        return cls(**plain)


def describe_conversion(conversion: Conversion) -> str:
    """Return a step in words, for ``vlatool inspect``.

    Example:
        >>> describe_conversion(Conversion("relative", ("arm",), to="state"))
        "relative, parts ['arm'], to 'state'"
    """
    plain = to_json(conversion, defaults=False)
    return ", ".join([plain.pop("op"), *(f"{name} {value!r}" for name, value in plain.items())])


@dataclass(frozen=True)
class Layout:
    """Where the named parts of a vector lie, between two conversions.

    Args:
        names: part or label -> [start, stop).
    """

    width: int
    names: Mapping[str, Span]

    def spans(self, selectors: tuple[Selector, ...], where: str) -> tuple[Span, ...]:
        """Return the places of parts, of the whole vector where none is named.

        Raises:
            SpecError: for a name that is not known here, and places outside of the vector.
        """
        return tuple(self._span(each, where) for each in selectors) if selectors else ((0, self.width),)

    def _span(self, selector: Selector, where: str) -> Span:
        if isinstance(selector, str):
            if selector not in self.names:
                raise SpecError(
                    f"{where} names the part '{selector}'; {suggest(selector, self.names)}.",
                    "name it under 'parts' of the tensor: NAME: [START, STOP], or among its labels",
                )
            return self.names[selector]
        start, stop = selector if isinstance(selector, tuple) else (selector, selector + 1)
        if stop > self.width:
            raise SpecError(
                f"{where} has the part {short_repr(selector)} of a vector of {amount(self.width, 'element')}."
            )
        return start, stop

    def after(self, conversion: Conversion) -> Layout:
        """Return where the parts lie on the side of the network of a step."""
        layout = self
        if conversion.growth:
            for start, stop in sorted(self.spans(conversion.parts, conversion.where), reverse=True):
                layout = layout._resized(start, stop, conversion.growth)
        return layout

    def _resized(self, start: int, stop: int, growth: int) -> Layout:
        """Return the layout after one part has more elements; names that lie in it or are cut by it are gone."""
        names = {
            name: (first + growth * (first >= stop), last + growth * (last >= stop))
            for name, (first, last) in self.names.items()
            if last <= start or first >= stop or (first <= start and last >= stop)
        }
        return Layout(self.width + growth, names)


def conversions_from(data: Any) -> tuple[Conversion, ...]:
    """Build the steps of ``convert`` from a list of mappings.

    Raises:
        SpecError: for anything else, and for more than ``MAX_CONVERSIONS``.
    """
    steps = sequence(data, "'convert'", SpecError)
    if len(steps) > MAX_CONVERSIONS:
        raise SpecError(f"'convert' has {len(steps)} steps; allowed: up to {MAX_CONVERSIONS}.")
    return tuple(step if isinstance(step, Conversion) else Conversion.from_dict(step) for step in steps)


def parts_from(data: Any, where: str) -> dict[str, Span]:
    """Return the named parts of a vector: name -> [start, stop), from such pairs or the place of one element.

    Raises:
        SpecError: for anything else.
    """
    found = {}
    for name, places in mapping(data, f"The parts of {where}", SpecError).items():
        text(name, f"The name of a part of {where}", SpecError, empty=False)
        span = _selector(places, f"The part '{name}' of {where}")
        if isinstance(span, str):
            raise SpecError(f"The part '{name}' of {where} is {short_repr(span)}; wanted: [START, STOP], or a number.")
        found[name] = (span[0], span[1]) if isinstance(span, tuple) else (span, span + 1)
    return found


def layouts_of(robot: Layout, conversions: tuple[Conversion, ...]) -> list[Layout]:
    """Return the layout on the side of the robot of each step, and that of the network at the end.

    Raises:
        SpecError: for parts that are not there, or overlap.
    """
    layouts = [robot]
    for conversion in conversions:
        conversion.check_spans(layouts[-1].spans(conversion.parts, conversion.where))
        layouts.append(layouts[-1].after(conversion))
    return layouts


def _selectors(values: Any, where: str) -> tuple[Selector, ...]:
    """Return what names parts; one name that stands alone is accepted, too."""
    listed = [values] if isinstance(values, str) else sequence(values, where, SpecError)
    return tuple(_selector(each, where) for each in listed)


def _selector(value: Any, where: str) -> Selector:
    if isinstance(value, str):
        return text(value, where, SpecError, empty=False)
    if not isinstance(value, list | tuple):
        return integer(value, where, SpecError)
    if len(value) != 2:
        raise SpecError(f"{where} is {short_repr(value)}; wanted: a name, a number, or [START, STOP].")
    start = integer(value[0], where, SpecError)
    return start, integer(value[1], f"{where} ends where it", SpecError, start + 1)


def _number(value: Any, where: str) -> float:
    """Return a finite number with which float32 can be computed."""
    number = finite_number(value, where, SpecError)
    if abs(number) > LARGEST:
        raise SpecError(f"{where} is {number:g}; allowed: -{LARGEST:g} to {LARGEST:g}.")
    return number


def _one_of(value: Any, allowed: Mapping[str, Any] | tuple[str, ...], where: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        hint = suggest(value, allowed) if isinstance(value, str) else "it must be text"
        raise SpecError(f"{where} {short_repr(value)}; {hint}.")
