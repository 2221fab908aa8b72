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
MIN_LIKE, MIN_WORD = 0.8, 4
"""How alike a word is to the one that it is a slip of, and its letters."""


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
    words = {word for text in counts for word in _plain(text).split()}
    many = _are_many([text not in counts for text, _ in set(zip(log, episodes[0], strict=True))], counts)
    for text, count in Counter(log).most_common():
        if text in counts or not text.strip():
            continue
        sentence = f"'{name}' is {text!r} in {amount(count, 'row')}, which was never recorded"
        if written := relation(text, list(counts)):
            yield f"{sentence}: {written}"
        elif unknown := [word for word in _plain(text).split() if word not in words]:
            yield f"{sentence}, nor was the word {unknown[0]!r}"
        elif many:
            near = difflib.get_close_matches(text, list(counts), 1, 0.0)[0]
            yield f"{sentence}; the nearest that was is {near!r}"


def explain_paired(name: str, log: Sequence[str], reference: Sequence[str]) -> Iterator[Explanation]:
    """Yield what is wrong with the texts of rows that are of the same moments as those of the reference."""
    other = Counter((mine, right) for mine, right in zip(log, reference, strict=True) if mine != right)
    rows = other.total()
    if not rows:
        return
    (mine, right), _ = other.most_common(1)[0]
    known = sorted({*reference})
    if not mine.strip():
        words = "it is empty"
    elif mine in known:
        words = f"it is {mine!r}, the text of another task"
    else:
        words = f"it is {mine!r}: {relation(mine, [right]) or 'a text that was never recorded'}"
    where = f"{words}, where {right!r} was recorded, in {rows} of {amount(len(log), 'row')}"
    yield Explanation(name, TEXT, where, rows / len(log), 0.0, len(log), remedy=REMEDY)


def relation(text: str, known: Sequence[str]) -> str:
    """Say how a text was written in the reference: in other case or punctuation, or without the words around it.

    Returns:
        an empty text when it is near to none that is known.
    """
    plain = {_plain(each): each for each in sorted(known, key=len) if _plain(each)}
    if same := plain.get(_plain(text)):
        return f"it was written {same!r}"
    inside = [each for each in plain if f" {each} " in f" {_plain(text)} "]
    if inside:
        return (
            f"it was written {plain[inside[-1]]!r}, without the words around it ({_around(_plain(text), inside[-1])!r})"
        )
    around = [each for each in plain if f" {_plain(text)} " in f" {each} "]
    if around and len(_plain(text).split()) > 1:
        return f"it was written {plain[around[0]]!r}, with words around it ({_around(around[0], _plain(text))!r})"
    near = difflib.get_close_matches(_plain(text), list(plain), 1, MIN_LIKE)
    return f"it is near to {plain[near[0]]!r}: a slip?" if near and _is_slip(_plain(text), near[0]) else ""


def _around(whole: str, part: str) -> str:
    """Return the words around a part, with ``...`` in its place."""
    before, _, after = f" {whole} ".partition(f" {part} ")
    return " ".join(each for each in (before.strip(), "...", after.strip()) if each)


def _is_slip(text: str, known: str) -> bool:
    """Return whether two texts have the same words but one, which is written almost alike."""
    one, other = text.split(), known.split()
    apart = [(a, b) for a, b in zip(one, other, strict=False) if a != b]
    alike = len(apart) == 1 and difflib.SequenceMatcher(None, *apart[0]).ratio() >= MIN_LIKE
    return len(one) == len(other) and alike and min(map(len, apart[0])) >= MIN_WORD


def _are_many(new: Sequence[bool], counts: Counter[str]) -> bool:
    """Return whether so many texts are new as a right log has with a chance of ``MAX_CHANCE`` at most."""
    share = (sum(count == 1 for count in counts.values()) + 1) / (counts.total() + 1)
    rest = range(sum(new), len(new) + 1)
    return sum(math.comb(len(new), k) * share**k * (1 - share) ** (len(new) - k) for k in rest) < MAX_CHANCE


def _plain(text: str) -> str:
    return " ".join("".join(each if each.isalnum() else " " for each in text.casefold()).split())
