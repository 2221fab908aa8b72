"""How an instruction becomes the prompt that a language model was trained on: a part of the spec of a text input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vlatool.errors import SpecError
from vlatool.files.messages import field_values
from vlatool.files.validate import integer, short_repr, text

PLACE = "{}"


@dataclass(frozen=True)
class Prompt:
    """What is written around an instruction.

    Args:
        template: the prompt, with ``{}`` in the place of the instruction.
        lower: whether the instruction is written in lower case.
        last: id with which the ids of the prompt end, appended where they do not; none when it is left out.
    """

    template: str = PLACE
    lower: bool = False
    last: int | None = None

    def __post_init__(self) -> None:
        text(self.template, "The template of a prompt", SpecError)
        if self.template.count(PLACE) != 1:
            raise SpecError(
                f"The template of a prompt is {short_repr(self.template)}; it has {PLACE} once, for the instruction."
            )
        if not isinstance(self.lower, bool):
            raise SpecError(f"A prompt has lower {short_repr(self.lower)}; it must be true or false.")
        if self.last is not None:
            integer(self.last, "The last id of a prompt", SpecError)

    def write(self, instruction: str) -> str:
        """Return the prompt for an instruction.

        Example:
            >>> Prompt("In: {}? Out:", lower=True).write("Open it")
            'In: open it? Out:'
        """
        before, _, behind = self.template.partition(PLACE)
        return f"{before}{instruction.lower() if self.lower else instruction}{behind}"

    def end(self, ids: list[int]) -> list[int]:
        """Return ids that end as the prompt does."""
        return ids if self.last is None or ids[-1:] == [self.last] else [*ids, self.last]

    @classmethod
    def from_dict(cls, data: Any) -> Prompt:
        """Build from a mapping as in ``manifest.json`` or ``policy.yaml``.

        Raises:
            SpecError: for an unknown key or an impossible value.
        """
        return cls(**field_values(cls, data, "A prompt", SpecError))
