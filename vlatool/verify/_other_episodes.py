"""Explanations of a log whose episodes the reference does not hold: by what holds in each episode of a right robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import Recording
from vlatool.files.rows import in_memory
from vlatool.verify._appearance import CHANGES, MAX_FRAMES, RIGHT, Appearance, Looks, Verdict
from vlatool.verify._diagnosis import Scales, explain
from vlatool.verify._explanation import Explanation
from vlatool.verify._model import Model
from vlatool.verify._reading import Changes, Names, Reader, rows_of
from vlatool.verify._search import (
    DELAY_KIND,
    FACTOR_KIND,
    ORDER_KIND,
    SIGN_KIND,
    STATISTICS_KIND,
    Component,
    Finding,
    episodes_of,
)
from vlatool.verify._series import Series
from vlatool.verify._tasks import Tasks
from vlatool.verify._texts import explain_empty, unknown_texts
from vlatool.verify._vectors import FACTORS

Indices = NDArray[np.int64]
MAX_NAMES = 6
SPARSE = "rows are several control steps apart, which hides what follows from the commands: record every step"


@dataclass(frozen=True)
class Outcome:
    """What was found in a log of other episodes.

    Args:
        suspicious: sentences on what differs from the reference, which no wrong wiring explains.
        unseen: sentences on what this log could not show.
    """

    explanations: tuple[Explanation, ...]
    suspicious: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    components: tuple[tuple[str, Component], ...] = field(default=(), repr=False)


@dataclass(frozen=True, eq=False)
class Judge:
    """What logs of other episodes are compared with.

    Args:
        images: image -> classifier of how it looks.
        tasks: input of text -> classifier of the tasks that it names.
    """

    spec: PolicySpec
    reader: Reader
    model: Model
    images: Mapping[str, Appearance]
    texts: Mapping[str, Sequence[str]]
    series: Series
    tasks: Mapping[str, Tasks]

    @classmethod
    def of(cls, spec: PolicySpec, names: Names, reference: Recording) -> Judge:
        """Fit everything to a recording of right wiring."""
        (series, noisy, shifted), reader = Reader(spec, names).variants(reference)
        model = Model.of(names, series, spec.action.kind == "discrete").with_bounds(series, noisy, shifted)
        rows, episodes, groups = rows_of(reference, spec)
        shown = _spread(len(rows))
        looks = _looks(spec, names, reference, rows[shown])
        images = {name: Appearance.of(_of_size(looks, name), name, groups[shown], episodes[shown]) for name in looks}
        texts = _texts(spec, reference, rows[shown])
        found = {name: Tasks.of(looks, each, episodes[shown]) for name, each in texts.items()}
        tasks = {name: each for name, each in found.items() if each is not None}
        return cls(spec, reader, model, images, _texts(spec, reference, rows), series, tasks)

    def explain(self, log: Recording, scales: Scales) -> Outcome:
        """Say what is wrong with a log."""
        rows, episodes, _ = rows_of(log, self.spec)
        looks = _looks(self.spec, self.reader.names, log, rows[_spread(len(rows))])
        verdicts = {name: self.images[name].judge(looks[name]) for name in looks}
        (series, *_), _ = self.reader.variants(log, _changes(verdicts))
        model = self.model.for_log(series, known=self._is_known(log, rows))
        found, right = explain(model, series, scales)
        wrong = list(_of_images(verdicts, len(rows)))
        explanations = [*wrong, *self._of_texts(log, rows), *(() if wrong else self._of_tasks(log, looks, rows))]
        for name, finding in found:
            explanations += self._of_signal(model, name, finding, len(rows))
        suspicious = [*_odd_images(verdicts), *self._odd_texts(log, rows, episodes), *self._odd_levels(right)]
        unseen = {name: model.finding(right, name, model.needed[name]).unseen for name in model.signals}
        sentences = [each for name in unseen for each in self._unseen(model, name, unseen[name], len(right))]
        if not self.reader.names.dense:
            sentences.append(SPARSE)
        components = tuple((name, each) for name in unseen for each in unseen[name])
        return Outcome(tuple(explanations), tuple(suspicious), tuple(sentences), components)

    def _is_known(self, log: Recording, rows: Indices) -> bool:
        """Return whether the reference has each text of the log, and other episodes with it."""
        mine = _texts(self.spec, log, rows)
        return bool(mine) and all({*mine[name]} <= {*self.texts[name]} for name in mine)

    def labels(self, name: str) -> Sequence[str]:
        """Return a name for each element of a signal."""
        tensor = next((each for each in (*self.spec.inputs, self.spec.action) if each.name == name), None)
        width = self.series.values[name].shape[1]
        if name in self.reader.codes:
            return [f"{value:g}" for value in self.reader.codes[name].tolist()]
        own = tensor.labels if tensor is not None else ()
        return own if len(own) == width else [f"[{index}]" for index in range(width)]

    def _of_signal(self, model: Model, name: str, finding: Finding, rows: int) -> Iterator[Explanation]:
        """Yield the changes of a signal, those of the same kind and factor as one."""
        together: dict[tuple[str, float, bool], list[Component]] = {}
        for each in finding.components:
            together.setdefault((each.kind, each.factor, each.negated), []).append(each)
        for (kind, _, _), components in together.items():
            where = _words(self.labels(name), finding, components)
            evidence = sum(each.evidence for each in components)
            needed = max(model.needed[name].values()) if kind == STATISTICS_KIND else model.needed[name][kind]
            yield Explanation(name, kind, where, 1.0, 0.0, rows, paired=False, evidence=evidence, needed=needed)

    def _of_texts(self, log: Recording, rows: Indices) -> Iterator[Explanation]:
        for name, mine in _texts(self.spec, log, rows).items():
            yield from explain_empty(name, mine, self.texts[name])

    def _of_tasks(self, log: Recording, looks: Mapping[str, Looks], rows: Indices) -> Iterator[Explanation]:
        """Yield texts of another task than the images are of, where the images look right."""
        for name, mine in _texts(self.spec, log, rows[_spread(len(rows))]).items():
            if name in self.tasks:
                yield from self.tasks[name].explain(name, looks, mine)

    def _odd_texts(self, log: Recording, rows: Indices, episodes: Indices) -> Iterator[str]:
        for name, mine in _texts(self.spec, log, rows).items():
            yield from unknown_texts(name, mine, self.texts[name], (episodes.tolist(), self.series.episodes.tolist()))

    def _odd_levels(self, series: Series) -> Iterator[str]:
        """Yield elements that are further outside of what was recorded than that is wide."""
        for name in self.reader.names.vectors:
            labels = self.labels(name)
            middle = np.median(episodes_of(series.values[name], series)[0], axis=0)
            low, high = np.quantile(self.series.values[name], (0.01, 0.99), axis=0)
            width = np.maximum(high - low, self.model.levels[name].still)
            for index in np.flatnonzero((middle < low - width) | (middle > high + width)).tolist():
                yield (f"'{name}', {labels[index]}: {middle[index]:.4g} in the middle of the log, recorded was "
                       f"{low[index]:.4g} to {high[index]:.4g}: another place, or an offset")  # fmt: skip

    def _unseen(self, model: Model, name: str, unseen: Sequence[Component], rows: int) -> Iterator[str]:
        """Yield what a log cannot show of a signal, and how many rows would."""
        labels, parts = self.labels(name), []
        for kind, words in ((SIGN_KIND, "the sign of {}"), (ORDER_KIND, "an exchange of {}")):
            found = [" and ".join(labels[at] for at in each.elements) for each in unseen if each.kind == kind]
            more = f" and {len(found) - MAX_NAMES} more" if len(found) > MAX_NAMES else ""
            parts += [words.format("; ".join(found[:MAX_NAMES]) + more)] if found else []
        if late := [each for each in unseen if each.kind == DELAY_KIND]:
            steps = ", ".join(str(each.elements[0]) for each in late)
            parts.append(f"a delay of {steps} control steps{_rows_needed(late, model.needed[name][DELAY_KIND], rows)}")
        if parts:
            yield f"'{name}': this log could not show {', '.join(parts)}"


def _rows_needed(components: Sequence[Component], needed: float, rows: int) -> str:
    least = min(each.evidence for each in components)
    return f" (about {int(np.ceil(rows * needed / least))} rows would)" if least > 0.5 else ""


def _words(labels: Sequence[str], finding: Finding, components: Sequence[Component]) -> str:
    """Return the changes of one kind in words."""
    first, fix = components[0], finding.fix
    if first.kind == DELAY_KIND:
        low, high = min(first.elements), max(first.elements)
        steps = f"{low}" if low == high else f"{low} to {high}"
        return f"{steps} control step{'s' if high > 1 else ''} {'late' if fix.delay > 0 else 'early'}"
    if first.kind == STATISTICS_KIND:
        return f"all elements: {first.words}"
    elements = sorted(at for each in components for at in each.elements)
    if first.kind == ORDER_KIND:
        return ", ".join(f"{labels[at]} holds {labels[fix.order[at]]}" for at in elements)
    where = "all elements" if len(elements) == len(labels) > 1 else ", ".join(labels[at] for at in elements)
    if first.kind == FACTOR_KIND:
        where += f": {FACTORS[first.factor]} (a factor of {first.factor:.4g})"
        return where + (", and negated" if first.negated else "")
    return where


def _spread(count: int) -> Indices:
    return np.unique(np.linspace(0, count - 1, MAX_FRAMES).astype(int))


def _image_tensors(spec: PolicySpec, names: Names) -> list[TensorSpec]:
    return [each.observation for each in spec.inputs if each.name in names.images]


def _looks(spec: PolicySpec, names: Names, recording: Recording, rows: Indices) -> dict[str, Looks]:
    return {each.name: Looks.of(each, recording.inputs[each.name], rows) for each in _image_tensors(spec, names)}


def _of_size(looks: Mapping[str, Looks], name: str) -> dict[str, Looks]:
    """Return the images that may stand in the place of one: of as many blocks and colours."""
    return {other: each for other, each in looks.items() if each.blocks.shape == looks[name].blocks.shape}


def _texts(spec: PolicySpec, recording: Recording, rows: Indices) -> dict[str, list[str]]:
    names = [each.name for each in spec.inputs if each.kind == "text"]
    return {name: in_memory(recording.inputs[name])[rows].astype(str).tolist() for name in names}


def _changes(verdicts: Mapping[str, Verdict]) -> Changes:
    """Return where the images of the log belong, and what turns them back."""
    found = {}
    for name, verdict in verdicts.items():
        kind, where = verdict.kind
        if kind == "flipped":
            found[name] = name, CHANGES[verdict.kind][0]
        elif kind == "swapped":
            found[where.split("'")[1]] = name, CHANGES[RIGHT][0]
    return found


def _of_images(verdicts: Mapping[str, Verdict], rows: int) -> Iterator[Explanation]:
    for name, verdict in verdicts.items():
        kind, where = verdict.kind
        if verdict.kind != RIGHT and verdict.fits:
            yield Explanation(name, kind, where, 1.0, 0.0, min(rows, MAX_FRAMES), paired=False,
                              evidence=verdict.margin, needed=max(verdict.needed, 0.0))  # fmt: skip


def _odd_images(verdicts: Mapping[str, Verdict]) -> Iterator[str]:
    for name, verdict in verdicts.items():
        if verdict.kind != RIGHT and not verdict.fits:
            yield (f"'{name}' looks unlike what was recorded, most like images that are {verdict.kind[0]} "
                   f"({verdict.kind[1]}), by a margin of {verdict.margin:.2f}")  # fmt: skip
