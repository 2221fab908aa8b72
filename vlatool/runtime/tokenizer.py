"""Text to token ids, from a ``tokenizers`` file or a plain list of words."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import SpecError, require

Encode = Callable[[str], list[int]]


class Tokenizer:
    """Turns an instruction into ids of fixed width; remembers the last instructions.

    Args:
        path: ``tokenizer.json`` of the ``tokenizers`` library, or a vocabulary
            ``{"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2}}`` (lower case, split at white space).
        max_tokens: Width that ids are padded or cut to.
        name: The input's name, for messages.

    Raises:
        SpecError: when the file is missing or is neither of the two.
    """

    remembered = 64

    def __init__(self, path: Path, max_tokens: int, name: str) -> None:
        self.max_tokens = max_tokens
        self.name = name
        self._cache: dict[str, NDArray[np.int64]] = {}
        data = _read(path, name)
        if data.get("kind") == "words":
            self.pad, self._encode = _words(data, path, name)
        elif "model" in data:
            self.pad, self._encode = _library(path)
        else:
            raise SpecError(
                f"{path} is no tokenizer: it has neither 'model' (tokenizers library) nor kind 'words' (vocabulary)."
            )

    def __call__(self, text: str) -> NDArray[np.int64]:
        """Return the ids of ``text``, int64, shape (1, max_tokens)."""
        known = self._cache.get(text)
        if known is None:
            if len(self._cache) >= self.remembered:
                self._cache.pop(next(iter(self._cache)))
            known = self._cache[text] = self._padded(text)
        return known

    def _padded(self, text: str) -> NDArray[np.int64]:
        found = self._encode(text)
        if len(found) > self.max_tokens:
            warnings.warn(
                f"the {self.name} has {len(found)} tokens; the last {len(found) - self.max_tokens} are cut",
                stacklevel=4,
            )
        row = np.full((1, self.max_tokens), self.pad, np.int64)
        row[0, : len(found)] = found[: self.max_tokens]
        return row


def _read(path: Path, name: str) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SpecError(f"The tokenizer of '{name}' cannot be read: {path} ({error.strerror}).") from error
    except ValueError as error:
        raise SpecError(f"The tokenizer of '{name}' is not valid JSON: {path}: {error}.") from error
    if not isinstance(data, dict):
        raise SpecError(f"The tokenizer of '{name}' must be a mapping: {path}.")
    return data


def _words(data: dict[str, Any], path: Path, name: str) -> tuple[int, Encode]:
    words, pad, unknown = data.get("words"), data.get("pad"), data.get("unknown")
    ids = isinstance(words, dict) and all(isinstance(number, int) for number in words.values())
    if not isinstance(words, dict) or not ids or not isinstance(pad, int) or not isinstance(unknown, int):
        raise SpecError(f"The vocabulary {path} needs 'words' (a mapping), 'pad' and 'unknown' (ids).")

    def encode(text: str) -> list[int]:
        parts = text.lower().split()
        strange = [part for part in parts if part not in words]
        if strange:
            warnings.warn(
                f"the {name} has words that the policy was not trained on: {', '.join(strange)}", stacklevel=5
            )
        return [words.get(part, unknown) for part in parts]

    return pad, encode


def _library(path: Path) -> tuple[int, Encode]:
    library = require("tokenizers", "text")
    try:
        tokenizer = library.Tokenizer.from_file(str(path))
    except Exception as error:  # the seam: the library raises plain Exception
        raise SpecError(f"{path} is no file of the tokenizers library: {error}.") from error
    tokenizer.no_truncation()
    padding = tokenizer.padding or {}
    tokenizer.no_padding()

    def encode(text: str) -> list[int]:
        return list(tokenizer.encode(text).ids)

    return int(padding.get("pad_id", 0)), encode
