"""Wrong wirings in logs of other episodes than the reference holds; ``wiring_trials.py --episodes other`` runs this.

The recordings are those of ``wiring_recordings.py``: references of 28 and 80 episodes, and logs of other episodes. A
wrong wiring is *found* when it is the only explanation, of the right signal and kind and with the right elements,
factor or delay; *undecidable* when nothing wrong is named and the report says of each element that is missing that
this log could not show it, or that it cannot tell the delay from another; and else *missed*. Right logs are of ordinary
episodes, of a task that the reference does not hold, and of episodes with another start, light, noise or camera pose.
"""

from __future__ import annotations

import functools
import json
import math
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import wiring_recordings
from wiring_recordings import Arrays, joined

from vlatool.bundle.bundle import Bundle, seal
from vlatool.data import Recording, build_recording
from vlatool.sources import open_source, source_bundle
from vlatool.stage.base import Context
from vlatool.verify._other_episodes import Judge, Outcome
from vlatool.verify._reading import names_of
from vlatool.verify._search import DELAY_KIND
from vlatool.verify._vectors import FACTORS
from vlatool.verify.log import MAX_WIDTH, explain_inputs

ROOT = Path(__file__).parents[3]
KINDS = ("permuted", "negated", "scaled", "delayed", "swapped", "statistics", "bgr", "text", "commands")
FOUND, UNDECIDABLE, MISSED, FALSE = "found", "undecidable", "missed", "false"
EPISODES = {"vln-babyai": 20, "vln-gru": 20}
"""Episodes of a log, 2 where nothing stands here."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A policy with its reference and logs."""

    name: str
    bundle: Bundle
    episodes: Mapping[str, Sequence[Arrays]]

    @functools.cached_property
    def reference(self) -> Recording:
        """The recording of right wiring."""
        return self.recording(self.episodes["reference"])

    @functools.cached_property
    def judge(self) -> Judge:
        """What logs are compared with."""
        spec = self.bundle.manifest.spec
        return Judge.of(spec, names_of(spec, self.reference, self.reference, MAX_WIDTH), self.reference)

    def recording(self, episodes: Sequence[Arrays]) -> Recording:
        """Return episodes as a recording; a log's are counted from 0, as those of the reference are."""
        return build_recording(Path("log.npz"), joined(episodes), self.bundle.manifest.spec, {})

    def explain(self, episodes: Sequence[Arrays]) -> Outcome:
        """Return what is found in a log."""
        return explain_inputs(self.bundle, self.recording(episodes), [self.reference], own=True, judge=self.judge)[0]

    @property
    def vectors(self) -> list[str]:
        """Names of the inputs that are vectors of floats."""
        return wiring_recordings.vector_inputs(self.bundle.manifest.spec)

    @property
    def images(self) -> list[str]:
        """Names of the inputs that are images."""
        return wiring_recordings.image_inputs(self.bundle.manifest.spec)

    def log(self, random: np.random.Generator, kind: str = "ordinary") -> list[Arrays]:
        """Return some episodes."""
        pool = self.episodes[kind]
        count = min(EPISODES.get(self.name, 2), len(pool))
        return [dict(pool[int(at)]) for at in random.choice(len(pool), count, replace=False)]


def subjects(recordings: Path, folder: Path, names: Sequence[str] = tuple(wiring_recordings.SEEDS)) -> list[Subject]:
    """Return the policies with their recordings, which are simulated where they are not there yet."""
    return [
        Subject(name, _bundle(name, folder, recordings), wiring_recordings.recorded(name, recordings)) for name in names
    ]


def _bundle(name: str, folder: Path, recordings: Path) -> Bundle:
    sample = "vla-metaworld" if name == "sawyer-joints" else name
    source = source_bundle(open_source(str(ROOT / "sample_models" / sample)), folder / "cache", Context()).bundle
    if name == sample:
        return source
    spec = source.manifest.spec
    image, state, text = spec.inputs
    joints = replace(state, name="joints", shape=(1, 8), labels=(), unit="", statistics="statistics.json#joints")
    action = replace(
        spec.action, shape=(1, 8, 8), labels=(), unit="", mode="absolute", statistics="statistics.json#leader"
    )
    inputs = (replace(image, name="front"), replace(image, name="wrist"), joints, text)
    copy = Path(shutil.copytree(source.path, folder / name))
    whole = joined(wiring_recordings.recorded(name, recordings)["reference"])
    table = {key: {"mean": whole[of].mean(axis=0).tolist(), "std": whole[of].std(axis=0).tolist()}
             for key, of in (("joints", "joints"), ("leader", "action"))}  # fmt: skip
    (copy / "assets/statistics.json").write_text(json.dumps(table))
    names = ("front", "wrist", "joints", text.name)
    program = tuple(replace(step, feeds={each: each for each in names}) for step in source.manifest.program)
    return seal(copy, replace(source.manifest, program=program, spec=replace(spec, inputs=inputs, outputs=(action,))))


@dataclass(frozen=True, eq=False)
class Case:
    """A planted wiring and what must be found.

    Args:
        elements: elements, or pairs of elements, that must be named as ``labels``, or said to be unseen.
    """

    subject: Subject
    episodes: Sequence[Arrays]
    signals: tuple[str, ...]
    kind: str
    words: tuple[str, ...] = ()
    elements: tuple[tuple[int, ...], ...] = ()
    labels: tuple[str, ...] = ()

    def judge(self) -> tuple[str, Outcome]:
        """Return whether it was found."""
        outcome = self.subject.explain(self.episodes)
        found = outcome.explanations
        named = {each.signal for each in found} == set(self.signals) and {each.kind for each in found} == {self.kind}
        if named and self.kind == DELAY_KIND:
            steps = [int(word) for word in found[0].where.split() if word.isdigit()]
            late = found[0].where.endswith("late") and min(steps) <= self.elements[0][0] <= max(steps)
            return (FOUND if len(steps) == 1 else UNDECIDABLE) if late else MISSED, outcome
        if named and all(any(word in each.where for each in found) for word in self.words):
            return FOUND, outcome
        if {(each.signal, each.kind) for each in found} <= {(self.signals[0], self.kind)} and self._is_unseen(outcome):
            return UNDECIDABLE, outcome
        return MISSED, outcome

    def _is_unseen(self, outcome: Outcome) -> bool:
        """Say whether the report tells of each element that is not named that this log could not show it."""
        said = {component.elements for name, component in outcome.components
                if name == self.signals[0] and component.kind == self.kind}  # fmt: skip
        words = " ".join(each.where for each in outcome.explanations)
        missing = [each for each, label in zip(self.elements, self.labels, strict=True) if label not in words]
        return bool(missing) and all(each in said for each in missing)


def plant(subject: Subject, kind: str, random: np.random.Generator) -> Case | None:
    """Return a wrong wiring of a kind, None where a policy cannot have it."""
    episodes, action = subject.log(random), subject.bundle.manifest.spec.action
    if kind == "commands":
        if action.kind == "discrete":
            order = np.array([[1, 0, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0]])[int(random.integers(4))]
            changed = [{**each, "action": order[each["action"]]} for each in episodes]
            return Case(subject, changed, (action.name,), "permuted", ())
        kind = str(random.choice(["permuted", "negated", "scaled", "delayed"]))
        return _with_elements(subject, episodes, "action", kind, random)
    pick = {"swapped": subject.images, "bgr": subject.images, "delayed": subject.images + subject.vectors}
    pick["text"] = [each.name for each in subject.bundle.manifest.spec.inputs if each.kind == "text"]
    names = pick.get(kind, subject.vectors)
    if not names or (kind == "swapped" and len(names) < 2):
        return None
    name = str(random.choice(names))
    if kind == "bgr":
        return Case(subject, [{**each, name: each[name][..., ::-1]} for each in episodes], (name,), kind)
    if kind == "swapped":
        one, other = names
        return Case(
            subject,
            [{**each, one: each[other], other: each[one]} for each in episodes],
            (one, other),
            kind,
            (one, other),
        )
    if kind == "text":
        return _with_text(subject, episodes, name)
    if kind == "statistics":
        return _with_statistics(subject, episodes, name, random)
    return _with_elements(subject, episodes, name, kind, random)


def _with_text(subject: Subject, episodes: list[Arrays], name: str) -> Case:
    return Case(
        subject, [{**each, name: np.full_like(each[name], "")} for each in episodes], (name,), "text", ("empty",)
    )


def _with_elements(subject: Subject, episodes: list[Arrays], name: str, kind: str, random: np.random.Generator) -> Case:
    spec = subject.bundle.manifest.spec
    tensor = spec.action if name == "action" else next(each for each in spec.inputs if each.name == name)
    signal = tensor.name
    if kind == "delayed":
        steps = int(random.integers(1, 4))
        late = [{**each, name: each[name][np.maximum(np.arange(len(each[name])) - steps, 0)]} for each in episodes]
        return Case(
            subject,
            late,
            (signal,),
            kind,
            (f"{steps} control step{'s' if steps > 1 else ''} late",),
            ((steps,),),
            ("late",),
        )
    width = episodes[0][name].shape[1]
    labels = tensor.labels or [f"[{index}]" for index in range(width)]
    some = np.sort(random.permutation(width)[: int(random.integers(1, width + 1))])
    if kind == "permuted":
        order = random.permutation(width)
        while (order == np.arange(width)).all():
            order = random.permutation(width)
        moved = [(at, int(other)) for at, other in enumerate(order) if at != other]
        words = tuple(f"{labels[at]} holds {labels[other]}" for at, other in moved)
        pairs = tuple((min(pair), max(pair)) for pair in moved)
        return Case(
            subject, [{**each, name: each[name][:, order]} for each in episodes], (signal,), kind, words, pairs, words
        )
    if kind == "negated":
        sign = np.where(np.isin(np.arange(width), some), np.float32(-1), np.float32(1))
        words = tuple(labels[index] for index in some) if len(some) < width else ("all elements",)
        elements = tuple((int(index),) for index in some)
        return Case(
            subject,
            [{**each, name: each[name] * sign} for each in episodes],
            (signal,),
            kind,
            words,
            elements,
            tuple(labels[index] for index in some),
        )
    factor = float(random.choice(list(FACTORS)))
    scale = np.where(np.isin(np.arange(width), some), np.float32(factor), np.float32(1))
    return Case(subject, [{**each, name: each[name] * scale} for each in episodes], (signal,), kind, (FACTORS[factor],))


def _with_statistics(subject: Subject, episodes: list[Arrays], name: str, random: np.random.Generator) -> Case:
    """Normalise what is normalised again, or give the bundle statistics of another order or unit."""
    file = subject.bundle.path / "assets/statistics.json"
    table = json.loads(file.read_text())
    mean, std = (np.array(table[name][key]) for key in ("mean", "std"))
    if random.random() < 0.5:
        changed = [{**each, name: ((each[name] - mean) / std).astype(np.float32)} for each in episodes]
        return Case(subject, changed, (name,), "statistics", ("normalised already",))
    way = int(random.integers(3))
    factor = [1000.0, 180 / math.pi, 1.0][way]
    shift = int(random.integers(1, len(mean))) if way == 2 else 0
    table[name] = {"mean": (factor * np.roll(mean, shift)).tolist(), "std": (factor * np.roll(std, shift)).tolist()}
    folder = Path(tempfile.mkdtemp(dir=subject.bundle.path.parent)) / "bundle"
    shutil.copytree(subject.bundle.path, folder)
    (folder / "assets/statistics.json").write_text(json.dumps(table))
    other = Subject(subject.name, seal(folder, subject.bundle.manifest), subject.episodes)
    other.__dict__.update(reference=subject.reference, judge=subject.judge)
    return Case(other, episodes, (name,), "statistics", ("not of the recorded data",))


Table = Counter[tuple[str, str, str]]
"""Policy, kind and result -> number of logs."""


def trials(policies: Sequence[Subject], wrong: int, right: int, seed: int) -> tuple[Table, list[str]]:
    """Plant wrong wirings, and try right logs; return the results and a line for each that is not found, or false."""
    random, table, lines = np.random.default_rng(seed), Table(), list[str]()
    kinds = [kind for kind in KINDS if any(plant(each, kind, random) for each in policies)]
    for number in range(max(wrong, right)):
        if number < wrong:
            lines += _wrong(policies, kinds[number % len(kinds)], random, table)
        if number * right // max(wrong, right) != (number + 1) * right // max(wrong, right):
            lines += _right(policies, number * right // max(wrong, right), random, table)
        if (number + 1) % 50 == 0:
            print(f"after {number + 1}:", summary(table)[0].rpartition("\n")[2], file=sys.stderr, flush=True)
    return table, lines


def _wrong(policies: Sequence[Subject], kind: str, random: np.random.Generator, table: Table) -> list[str]:
    case = None
    while case is None:
        case = plant(policies[int(random.integers(len(policies)))], kind, random)
    result, outcome = case.judge()
    table[case.subject.name, kind, result] += 1
    words = f"{case.subject.name} {kind} {case.signals} {case.words}"
    return [f"{result}: {words}: {_said(outcome)}"] if result != FOUND else []


def _right(policies: Sequence[Subject], number: int, random: np.random.Generator, table: Table) -> list[str]:
    subject = policies[number % len(policies)]
    ways = [way for way in subject.episodes if way != "reference"]
    way = ways[number // len(policies) % len(ways)]
    outcome = subject.explain(subject.log(random, way))
    result = FALSE if outcome.explanations else "suspicious" if outcome.suspicious else "right"
    table[subject.name, f"right, {way}", result] += 1
    return [f"{result}: {subject.name} right, {way}: {_said(outcome)}"] if result != "right" else []


def _said(outcome: Outcome) -> str:
    sentences = [each.sentence().rpartition(";")[0] for each in outcome.explanations]
    return "; ".join([*sentences, *(f"suspicious: {each}" for each in outcome.suspicious)]) or "nothing"


def summary(table: Table) -> tuple[str, bool]:
    """Return the results as text, and whether enough was found and nothing that is right."""
    lines = []
    for axis, name in ((1, "by kind"), (0, "by policy")):
        lines.append(f"{name:28} found undecidable missed | right suspicious false")
        for key in dict.fromkeys(each[axis] for each in table):
            count = Counter[str]()
            for each, number in table.items():
                count[each[2]] += number if each[axis] == key else 0
            lines.append(f"{key:28} {count[FOUND]:5} {count[UNDECIDABLE]:11} {count[MISSED]:6} | {count['right']:5} "
                         f"{count['suspicious']:10} {count[FALSE]:5}")  # fmt: skip
    count = Counter[str]()
    for each, number in table.items():
        count[each[2]] += number
    decidable = count[FOUND] + count[MISSED]
    total = decidable + count[UNDECIDABLE]
    share = count[FOUND] / max(decidable, 1)
    logs = count[FALSE] + count["suspicious"] + count["right"]
    lines.append(
        f"{count[FOUND]} of {total} wrong wirings named ({count[FOUND] / max(total, 1):.1%}), {share:.1%} of the "
        f"{decidable} that are decidable; of {count[UNDECIDABLE]} the report says what it cannot tell; "
        f"{count[FALSE]} of {logs} right logs found wrong"
    )
    return "\n".join(lines), share >= 0.95 and not count[FALSE]
