"""Whether the images of a log are of the task that its text names.

A linear classifier (ridge regression on one indicator a task) tells the tasks of the reference apart by how the images
look, in another light and from a camera that stands otherwise, too. Texts whose images it takes for each other in
episodes that it was not fitted on count as one task: other words for the same, or tasks of one scene. How far it
prefers another task in right episodes says what a log must show.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vlatool.files.printable import amount
from vlatool.verify._appearance import Looks
from vlatool.verify._bounds import upper_bound
from vlatool.verify._explanation import Explanation
from vlatool.verify._series import Array, Indices
from vlatool.verify._views import ridge

PARTS, MIN_EPISODES, MIN_MARGINS = 4, 2, 8
"""Parts of the episodes that are left out in turn; episodes of a text, and left out in all, from which it is judged."""
SHRINK = 0.3
SHIFTS, OTHER_SHIFTS = ((0, 1), (0, -1), (1, 0)), ((-1, 0), (1, 1))
"""Blocks by which a camera may see all elsewhere: those the classifier is fitted to, and those it is tried with."""
TEXT = "text"
REMEDY = "send the text of the task that is in front of the robot"


@dataclass(frozen=True, eq=False)
class Tasks:
    """A classifier of the tasks of a reference, of the texts that it has some episodes of.

    Args:
        texts: each text -> its task.
        weights: (F + 1, tasks).
        needed: by how much it prefers another task in right episodes at most.
    """

    texts: Mapping[str, int]
    weights: Array
    needed: float

    @classmethod
    def of(cls, looks: Mapping[str, Looks], texts: Sequence[str], episodes: Indices) -> Tasks | None:
        """Fit a classifier to images, and the texts and episodes that they are of.

        Returns:
            None where nothing can be told: an episode has several texts, a text too few episodes, or all look alike.
        """
        known = _positions(texts, episodes)
        position = np.array([known.get(key, -1) for key in zip(texts, episodes.tolist(), strict=True)])
        tasks = {text: at for at, text in enumerate(sorted({text for text, _ in known}))}
        least = max(2, len(tasks) // 2)
        if len(tasks) < 2 or not looks or len({*zip(texts, episodes.tolist(), strict=True)}) > len(np.unique(episodes)):
            return None
        seen, others = _variants(looks, 1, SHIFTS), _variants(looks, 2, OTHER_SHIFTS)
        while len(set(tasks.values())) >= least:
            at = np.array([tasks.get(text, -1) for text in texts])
            left_out = _left_out(seen, others, at, position, episodes)
            if len(left_out) < MIN_MARGINS:
                return None
            own, other, margins = max(left_out, key=lambda each: each[2][0])
            if margins[0] <= 0:
                needed = upper_bound([margin for *_, margins in left_out for margin in margins], 0.0)
                return cls(tasks, _fit(seen, at, at >= 0), needed)
            tasks = {text: min(own, other) if task in (own, other) else task for text, task in tasks.items()}
        return None

    def explain(self, name: str, looks: Mapping[str, Looks], texts: Sequence[str]) -> Iterator[Explanation]:
        """Yield the texts whose images look like those of another task.

        Args:
            texts: of the rows of the images.
        """
        features, named = _features(looks), np.array(texts)
        for text in sorted({*texts} & {*self.texts}):
            scores, own = _scores(self.weights, features[named == text]), self.texts[text]
            best = int(scores.argmax())
            if (margin := float(scores[best] - scores[own])) > self.needed:
                like = " or ".join(repr(each) for each, task in self.texts.items() if task == best)
                rows = int((named == text).sum())
                where = f"it is {text!r} in {amount(rows, 'row')}, whose images look like those of {like}"
                yield Explanation(name, TEXT, where, 1.0, 0.0, rows, paired=False, remedy=REMEDY, evidence=margin,
                                  needed=self.needed)  # fmt: skip


def _positions(texts: Sequence[str], episodes: Indices) -> dict[tuple[str, int], int]:
    """Return text and episode -> its position among the episodes of that text, of texts that have some."""
    numbers: dict[str, list[int]] = {}
    for text, number in sorted({*zip(texts, episodes.tolist(), strict=True)}):
        numbers.setdefault(text, []).append(number)
    return {(text, number): at for text, each in numbers.items() if text.strip() and len(each) >= MIN_EPISODES
            for at, number in enumerate(each)}  # fmt: skip


def _left_out(
    seen: Sequence[Array], others: Sequence[Array], at: Indices, position: Indices, episodes: Indices
) -> list[tuple[int, int, list[float]]]:
    """Return for each episode its task, the likeliest other, and its margin in the images and in changed ones.

    Args:
        others: the images first, and changed otherwise than those that the classifier is fitted to.
    """
    found = []
    for part in range(PARTS):
        left = (position >= 0) & (position % PARTS != part)
        if not {*at[position >= 0].tolist()} <= {*at[left].tolist()}:
            continue
        weights = _fit(seen, at, left)
        for number in np.unique(episodes[(position >= 0) & ~left]):
            rows = (episodes == number) & (position >= 0)
            scores, own = np.array([_scores(weights, features[rows]) for features in others]), int(at[rows][0])
            tasks = np.arange(scores.shape[1])
            rest = np.where(np.isin(tasks, at) & (tasks != own), scores, -np.inf)
            found.append((own, int(rest[0].argmax()), (rest.max(axis=1) - scores[:, own]).tolist()))
    return found


def _features(looks: Mapping[str, Looks]) -> Array:
    return np.concatenate([each.features() for each in looks.values()], axis=1)


def _variants(looks: Mapping[str, Looks], seed: int, shifts: Sequence[tuple[int, int]]) -> list[Array]:
    """Return the features of images as they are, in another light, and of cameras that stand otherwise."""
    relit = {name: each.relit(seed) for name, each in looks.items()}
    return [_features(each) for each in (looks, relit, *(_shifted(looks, shift) for shift in shifts))]


def _shifted(looks: Mapping[str, Looks], shift: tuple[int, int]) -> dict[str, Looks]:
    return {name: Looks(np.roll(each.blocks, shift, axis=(1, 2)), each.colours) for name, each in looks.items()}


def _scores(weights: Array, features: Array) -> Array:
    scores: Array = (features @ weights[:-1] + weights[-1]).mean(axis=0)
    return scores


def _fit(seen: Sequence[Array], at: Indices, chosen: np.ndarray) -> Array:
    rows = np.concatenate([features[chosen] for features in seen])
    return ridge(rows, np.tile(np.eye(int(at.max()) + 1)[at[chosen]], (len(seen), 1)), SHRINK)
