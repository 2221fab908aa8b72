"""How an instruction becomes the prompt that a language model was trained on: a part of the spec of a text input."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import SpecError
from vlatool.files.messages import field_values
from vlatool.files.validate import finite_number, integer, mapping, short_repr, text

INSTRUCTION_MARK, STATE_MARK = "{}", "{state}"
MAX_BINS = 1 << 16
"""Most bins of a state in a prompt: openpi has 256."""


@dataclass(frozen=True)
class StateText:
    """A state as a prompt has it: for each element the number of its bin, separated by spaces.

    Bins are of equal width, numbered from 0 at ``low``; below it is -1, above ``high`` the last bin. pi0.5 has them
    (``PaligemmaTokenizer.tokenize`` of openpi, ``Pi05PrepareStateTokenizerProcessorStep`` of LeRobot).

    Args:
        input: name of the input, a vector of floats; its values are written as the network has them, normalised.
        low: where the first bin begins.
        high: where the last bin ends.
        bins: number of bins.
    """

    input: str
    low: float = -1.0
    high: float = 1.0
    bins: int = 256

    def __post_init__(self) -> None:
        text(self.input, "The input of a prompt's state", SpecError, empty=False)
        low, high = (finite_number(getattr(self, side), f"The {side} of a prompt's state", SpecError)
                     for side in ("low", "high"))  # fmt: skip
        if integer(self.bins, "The bins of a prompt's state", SpecError, 1) > MAX_BINS or low >= high:
            raise SpecError(
                f"A prompt's state has {self.bins} bins from {low:g} to {high:g}; allowed: 1 to {MAX_BINS}, low below "
                "high."
            )

    def write(self, values: NDArray[Any]) -> str:
        """Return the numbers of a state.

        Args:
            values: (S,) or (1, S), as the network has them.

        Example:
            >>> StateText("state").write(np.array([-1.5, -1, 0, 0.999, 7], np.float32))
            '-1 0 128 255 255'
        """
        edges = np.linspace(self.low, self.high, self.bins + 1)[:-1]
        return " ".join(map(str, (np.digitize(np.ravel(values), edges) - 1).tolist()))

    @classmethod
    def from_dict(cls, data: Any) -> StateText:
        """Build from a mapping as in ``manifest.json`` or ``policy.yaml``.

        Raises:
            SpecError: for an unknown key, an impossible value, or without an input.
        """
        values = field_values(cls, data, "The state of a prompt", SpecError)
        return cls(**{"input": "", **values})


@dataclass(frozen=True)
class Prompt:
    """What is written around an instruction.

    Args:
        template: the prompt, with ``{}`` in the place of the instruction, and ``{state}`` in that of the state.
        lower: whether the instruction is written in lower case.
        last: id with which the ids of the prompt end, appended where they do not; none when it is left out.
        strip: whether white space at the ends of the instruction is left out.
        replace: what is written in the place of a character of the instruction: character -> text.
        state: what of an input is written into the prompt; nothing when None.
    """

    template: str = INSTRUCTION_MARK
    lower: bool = False
    last: int | None = None
    strip: bool = False
    replace: dict[str, str] = field(default_factory=dict)
    state: StateText | None = None

    def __post_init__(self) -> None:
        text(self.template, "The template of a prompt", SpecError)
        for mark, what in self._marks().items():
            if self.template.count(mark) != 1:
                raise SpecError(
                    f"The template of a prompt is {short_repr(self.template)}; it has {mark} once, for the {what}."
                )
        for name in ("lower", "strip"):
            if not isinstance(getattr(self, name), bool):
                raise SpecError(f"A prompt has {name} {short_repr(getattr(self, name))}; it must be true or false.")
        if self.last is not None:
            integer(self.last, "The last id of a prompt", SpecError)
        for character, other in mapping(self.replace, "What a prompt replaces", SpecError).items():
            if not isinstance(other, str) or len(character) != 1:
                got = f"{short_repr(character)}: {short_repr(other)}"
                raise SpecError(f"A prompt replaces {got}; wanted: one character, and the text in its place.")

    def _marks(self) -> dict[str, str]:
        return {INSTRUCTION_MARK: "instruction", **({STATE_MARK: "state"} if self.state else {})}

    def write(self, instruction: str, state: NDArray[Any] | None = None) -> str:
        """Return the prompt for an instruction.

        Args:
            state: (S,) or (1, S), values of the input that the prompt has, as the network has them.

        Raises:
            SpecError: when the prompt has a state and none is given.

        Example:
            >>> Prompt("In: {}? Out:", lower=True).write("Open it")
            'In: open it? Out:'
        """
        if self.state is not None and state is None:
            raise SpecError(f"The prompt has the state '{self.state.input}' in it; none was given.")
        words = {INSTRUCTION_MARK: self._cleaned(instruction)}
        if self.state is not None and state is not None:
            words[STATE_MARK] = self.state.write(state)
        pattern = "|".join(map(re.escape, words))
        return re.sub(pattern, lambda mark: words[mark[0]], self.template)

    def _cleaned(self, instruction: str) -> str:
        instruction = instruction.strip() if self.strip else instruction
        instruction = instruction.lower() if self.lower else instruction
        return instruction.translate({ord(character): other for character, other in self.replace.items()})

    def end(self, ids: list[int]) -> list[int]:
        """Return ids that end as the prompt does."""
        return ids if self.last is None or ids[-1:] == [self.last] else [*ids, self.last]

    @classmethod
    def from_dict(cls, data: Any) -> Prompt:
        """Build from a mapping as in ``manifest.json`` or ``policy.yaml``.

        Raises:
            SpecError: for an unknown key or an impossible value.
        """
        values = field_values(cls, data, "A prompt", SpecError)
        if values.get("state") is not None:
            values["state"] = StateText.from_dict(values["state"])
        return cls(**values)
