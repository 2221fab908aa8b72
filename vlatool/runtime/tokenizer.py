"""Text to token ids, from a ``tokenizers`` file or a plain list of words."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import DataError, SpecError, VlatoolError, require
from vlatool.files.json import read_json
from vlatool.files.limits import check_limit
from vlatool.files.printable import amount
from vlatool.runtime.assets import Assets, asset_path, read_asset
from vlatool.runtime.token_growth import growth

if TYPE_CHECKING:
    from vlatool.bundle.prompt import Prompt

SAVE = "save it with tokenizer.save(FILE) of the tokenizers library, or write a vocabulary: kind: words"
VOCABULARY = "write the id of each word under 'words', and the ids 'pad' and 'unknown'"

Encode = Callable[[str], list[int]]


class Tokenizer:
    """Turns an instruction into ids of fixed width; remembers the last prompts.

    Args:
        path: ``tokenizer.json`` of the ``tokenizers`` library, or a vocabulary
            ``{"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2}}`` (lower case, split at white space).
        max_tokens: Width that ids are padded or cut to.
        name: The input's name, for messages.
        content: What the file holds; it is read from ``path`` when None.
        prompt: What is written around a text; nothing when None.

    Raises:
        SpecError: when the file is missing or is neither of the two, or may lengthen a text beyond limits.
    """

    remembered = 64

    def __init__(
        self, path: Path, max_tokens: int, name: str, content: bytes | None = None, prompt: Prompt | None = None
    ) -> None:
        self.prompt = prompt
        self.max_tokens = max_tokens
        self.name = name
        self._growth = 1
        self._cache: dict[str, NDArray[np.int64]] = {}
        content = tokenizer_content(path.parent, path.name, name) if content is None else content
        data = read_json(content, f"The tokenizer {path} of '{name}'", SpecError, SAVE)
        if not isinstance(data, dict):
            raise SpecError(f"The tokenizer of '{name}' must be a mapping: {path}.", SAVE)
        if data.get("kind") == "words":
            self.pad, self._encode = _words(data, path, name)
        elif "model" in data:
            self._growth = growth(data, f"The tokenizer {path} of '{name}'")
            self.pad, self._encode = _library(content, path, name)
        else:
            raise SpecError(
                f"{path} is not a tokenizer: it has neither 'model' (tokenizers library) nor the kind 'words'.",
                SAVE,
            )

    def __call__(self, text: str, state: NDArray[Any] | None = None) -> NDArray[np.int64]:
        """Return the ids of ``text``, int64, shape (1, max_tokens).

        Args:
            state: what the prompt has of another input, where it has something, as the network has it.

        Raises:
            DataError: when the library cannot read it, or its prompt is too long: cut, it would ask for nothing.
        """
        text = text if self.prompt is None else self.prompt.write(text, state)
        known = self._cache.get(text)
        if known is None:
            if len(self._cache) >= self.remembered:
                self._cache.pop(next(iter(self._cache)))
            known = self._cache[text] = self._padded(text)
        return known

    def _padded(self, text: str) -> NDArray[np.int64]:
        check_limit(
            "text_characters",
            len(text) * self._growth,
            f"The {self.name}, as its tokenizer may lengthen it,",
            DataError,
        )
        ids = self._encode(text)
        if self.prompt is not None:
            ids = self.prompt.end(ids)
        if len(ids) > self.max_tokens and self.prompt is not None:
            raise DataError(
                f"The {self.name} makes a prompt of {amount(len(ids), 'token')}; the policy takes {self.max_tokens}.",
                "say it in fewer words",
            )
        if len(ids) > self.max_tokens:
            warnings.warn(
                f"the {self.name} has {amount(len(ids), 'token')}; the last {len(ids) - self.max_tokens} are cut",
                stacklevel=4,
            )
        row = np.full((1, self.max_tokens), self.pad, np.int64)
        row[0, : len(ids)] = ids[: self.max_tokens]
        return row


def tokenizer_content(assets: Assets, file: str, name: str) -> bytes:
    """Return the content of the tokenizer of an input; raises SpecError when it cannot be read."""
    try:
        return read_asset(assets, file, "tokenizer_bytes")
    except OSError as error:
        raise SpecError(
            f"The tokenizer of '{name}' cannot be read: {asset_path(assets, file)} ({error.strerror}).",
            "put the file there, or correct its name in the spec",
        ) from error


def _words(data: dict[str, Any], path: Path, name: str) -> tuple[int, Encode]:
    words, pad, unknown = data.get("words"), data.get("pad"), data.get("unknown")
    if not isinstance(words, dict) or not all(map(_is_id, words.values())) or not _is_id(pad) or not _is_id(unknown):
        raise SpecError(f"The vocabulary {path} needs 'words' (a mapping), 'pad' and 'unknown' (ids).", VOCABULARY)
    ids: dict[str, int] = words
    other, filler = int(str(unknown)), int(str(pad))

    def encode(text: str) -> list[int]:
        parts = text.lower().split()
        strange = [part for part in parts if part not in ids]
        if strange:
            warnings.warn(
                f"the {name} has words that the policy was not trained on: {', '.join(strange)}", stacklevel=5
            )
        return [ids.get(part, other) for part in parts]

    return filler, encode


def _is_id(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63


def _library(content: bytes, path: Path, name: str) -> tuple[int, Encode]:
    library = require("tokenizers", "text")
    with _foreign(SpecError, f"{path} is not a file of the tokenizers library", SAVE):
        tokenizer = library.Tokenizer.from_buffer(content)
        tokenizer.no_truncation()
        padding = tokenizer.padding or {}
        tokenizer.no_padding()
        pad = int(padding.get("pad_id", 0))

    def encode(text: str) -> list[int]:
        with _foreign(DataError, f"The {name} cannot be turned into tokens", "give another text"):
            return list(tokenizer.encode(text).ids)

    return pad, encode


@contextlib.contextmanager
def _foreign(error: type[VlatoolError], what: str, fix: str) -> Iterator[None]:
    """The seam: the library raises plain Exception, and where it panics, something that is not even that."""
    try:
        yield
    except BaseException as foreign:
        if isinstance(foreign, Exception) or type(foreign).__name__ == "PanicException":
            raise error(f"{what}: {str(foreign)[:300]}.", fix) from foreign
        raise
