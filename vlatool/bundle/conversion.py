"""Conversions between the values of a robot and those of a network, computed by ``vlatool.runtime.converter``.

An input passes its list from first to last, the action from last to first.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from vlatool.errors import SpecError, suggest
from vlatool.files.messages import to_json
from vlatool.files.validate import integer, known_keys, mapping, sequence, short_repr, text

OPERATIONS: dict[str, tuple[str, ...]] = {
    "relative": ("parts", "to", "state", "successive"),
    "normalisation": (),
}
"""What is done to a vector -> the keys that say how."""
OUTPUTS_ALONE = ("relative",)
MAX_CONVERSIONS = 32
Span = tuple[int, int]
Selector = str | int | tuple[int, ...]
"""A name of a part or label, the place of an element, or [start, stop)."""


@dataclass(frozen=True)
class Conversion:
    """One step between the values of the robot and those of the network.

    Args:
        op: ``relative``: the network gives differences from what an input holds at the time of inference.
            ``normalisation`` stands where the statistics of the tensor are applied: after the last step if it is left
            out; steps behind it are done to normalised values.
        parts: what the step is done to: names of parts or labels, places of elements, or [start, stop] (stop is not
            part of it); the whole vector when left out. Places count the elements as they are before the step.
        to: of ``relative``: name of the input that holds the state, in the units of the action; of a history, the
            newest moment.
        state: of ``relative``: the parts of that input, one for each of ``parts``; the same ones when left out.
        successive: of ``relative``: whether each action is a difference from the one before it in the chunk, and the
            first from the state; otherwise all are differences from the state.
    """

    op: str
    parts: tuple[Selector, ...] = ()
    to: str = ""
    state: tuple[Selector, ...] = ()
    successive: bool = False

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
        if self.state and len(self.state) != len(self.parts):
            raise SpecError(
                f"{self.where} has {len(self.parts)} parts and {len(self.state)} parts of the state.",
                "name one part in 'state' for each of 'parts'",
            )

    @property
    def growth(self) -> int:
        """Elements that each part has more on the side of the network than on that of the robot."""
        return 0

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
            raise SpecError(f"{where} has the part {short_repr(selector)} of a vector of {self.width} elements.")
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
        place = _selector(places, f"The part '{name}' of {where}")
        if isinstance(place, str):
            raise SpecError(f"The part '{name}' of {where} is {short_repr(place)}; wanted: [START, STOP], or a number.")
        found[name] = (place[0], place[1]) if isinstance(place, tuple) else (place, place + 1)
    return found


def layouts_of(robot: Layout, conversions: tuple[Conversion, ...]) -> list[Layout]:
    """Return the layout on the side of the robot of each step, and that of the network at the end.

    Raises:
        SpecError: for parts that are not there, or overlap.
    """
    layouts = [robot]
    for conversion in conversions:
        spans = sorted(layouts[-1].spans(conversion.parts, conversion.where))
        for (_, stop), (start, _) in itertools.pairwise(spans):
            if start < stop:
                raise SpecError(f"{conversion.where} has parts that overlap; each element may be converted once.")
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


def _one_of(value: Any, allowed: Mapping[str, Any] | tuple[str, ...], where: str) -> None:
    if not isinstance(value, str) or value not in allowed:
        hint = suggest(value, allowed) if isinstance(value, str) else "it must be text"
        raise SpecError(f"{where} {short_repr(value)}; {hint}.")
