"""Texts of a log: empty, or never recorded."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Iterator, Sequence

from vlatool.files.printable import amount
from vlatool.verify._explanation import Explanation

TEXT = "text"
REMEDY = "send the text that belongs to the task, written as in the training"
MAX_CHANCE = 0.01


def explain_empty(name: str, log: Sequence[str], reference: Sequence[str]) -> Iterator[Explanation]:
    """Yield whether texts are empty that never are in the reference."""
    empty = sum(not text.strip() for text in log)
    if empty and all(text.strip() for text in reference):
        where = f"it is empty in {empty} of {amount(len(log), 'row')}"
        yield Explanation(name, TEXT, where, 1.0, 0.0, len(log), remedy=REMEDY)


def unknown_texts(
    name: str, log: Sequence[str], reference: Sequence[str], episodes: tuple[Sequence[int], Sequence[int]]
) -> Iterator[str]:
    """Yield a sentence for each text that the reference never has, with the nearest that it has.

    Texts of known words are only told if there are more of them than expected: the share of new texts is that of the
    texts that a single episode of the reference has (I. J. Good, The Population Frequencies of Species, Biometrika 40,
    1953).

    Args:
        episodes: of each row of the log, and of the reference.
    """
    counts = Counter(text for text, _ in set(zip(reference, episodes[1], strict=True)))
    plain = {_plain(text): text for text in sorted(counts)}
    words = {word for text in plain for word in text.split()}
    many = _are_many([text not in counts for text, _ in set(zip(log, episodes[0], strict=True))], counts)
    for text, count in Counter(log).most_common():
        if text in counts or not text.strip():
            continue
        sentence = f"'{name}' is {text!r} in {amount(count, 'row')}, which was never recorded"
        if same := plain.get(_plain(text)):
            yield f"{sentence}: it was written {same!r}"
        elif unknown := [word for word in _plain(text).split() if word not in words]:
            yield f"{sentence}, nor was the word {unknown[0]!r}"
        elif many:
            near = difflib.get_close_matches(text, list(counts), 1, 0.0)[0]
            yield f"{sentence}; the nearest that was is {near!r}"


def _are_many(new: Sequence[bool], counts: Counter[str]) -> bool:
    """Return whether so many texts are new as a right log has with a chance of ``MAX_CHANCE`` at most."""
    share = (sum(count == 1 for count in counts.values()) + 1) / (counts.total() + 1)
    rest = range(sum(new), len(new) + 1)
    return sum(math.comb(len(new), k) * share**k * (1 - share) ** (len(new) - k) for k in rest) < MAX_CHANCE


def _plain(text: str) -> str:
    return " ".join("".join(each if each.isalnum() else " " for each in text.casefold()).split())
