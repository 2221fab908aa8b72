"""Wrong wirings, planted in logs of five policies: each must be found and named, and nothing in logs of right ones.

    python tests/validation/soak/wiring_trials.py --wrong 500 --right 100
    python tests/validation/soak/wiring_trials.py --wrong 500 --right 110 --episodes other --recordings FOLDER

With ``--episodes other`` the logs are of episodes that the reference does not hold: see ``wiring_elsewhere.py``. Else
they are streams between recorded observations of the four sample policies and of the tiny policy of the tests with a
second camera: four control steps from one observation to the next, with noise of a sensor. A wrong wiring counts as
found when it is the only explanation, of the right signal, of the right kind and with the right elements, factor or
delay. Right logs are of the same episodes with more noise, of other episodes, and of a part of the episodes.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT / "tests")]

import wiring_elsewhere  # noqa: E402
import wiring_recordings  # noqa: E402
from _tiny import observations, write_policy  # noqa: E402

from vlatool.bundle.bundle import Bundle, seal  # noqa: E402
from vlatool.data import Recording, build_recording, evaluation_recording, recordings_of  # noqa: E402
from vlatool.data._reader import read_recording  # noqa: E402
from vlatool.files.rows import Rows  # noqa: E402
from vlatool.sources import open_source, source_bundle  # noqa: E402
from vlatool.stage.base import Context  # noqa: E402
from vlatool.verify._explanation import Explanation  # noqa: E402
from vlatool.verify._images import changes_of  # noqa: E402
from vlatool.verify._vectors import FACTORS  # noqa: E402
from vlatool.verify.log import explain_inputs  # noqa: E402

SAMPLES = ("vln-babyai", "vla-metaworld", "vla-flow", "vln-gru")
KINDS = ("permuted", "negated", "scaled", "delayed", "swapped", "statistics", "bgr")
KNOTS, BETWEEN = 64, 4
"""Recorded observations of a stream, and its control steps from one to the next."""
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Subject:
    """A policy, and streams of right wiring: one as the reference, one of other episodes."""

    bundle: Bundle
    stream: Arrays
    other: Arrays

    def recording(self, arrays: Arrays, *, first: int = 0) -> Recording:
        """Return arrays as a recording with time stamps."""
        spec = self.bundle.manifest.spec
        times = (first + np.arange(len(next(iter(arrays.values()))))) / spec.control_hz
        return build_recording(Path("log.npz"), arrays, spec, {}, times)

    @property
    def vectors(self) -> list[str]:
        """Names of the inputs that are vectors of floats."""
        return wiring_recordings.vector_inputs(self.bundle.manifest.spec)

    @property
    def images(self) -> list[str]:
        """Names of the inputs that are images."""
        return wiring_recordings.image_inputs(self.bundle.manifest.spec)


def stream(recording: Recording, knots: int = KNOTS) -> Arrays:
    """Return observations with steps between them: numbers and pixels between both, integers and texts as before."""
    arrays = {}
    chosen = np.array(recording.spread(knots))
    for name, values in recording.inputs.items():
        rows = (values.read(0, len(values)) if isinstance(values, Rows) else values)[chosen]
        ahead = np.concatenate([rows[1:], rows[-1:]])
        if rows.dtype.kind in "Ui" and rows.dtype != np.uint8:
            arrays[name] = np.repeat(rows, BETWEEN, axis=0)
            continue
        parts = [rows + (ahead.astype(np.float32) - rows) * np.float32(step / BETWEEN) for step in range(BETWEEN)]
        arrays[name] = np.stack(parts, axis=1).reshape(-1, *rows.shape[1:]).astype(rows.dtype)
    return arrays


def noisy(arrays: Arrays, random: np.random.Generator, share: float = 0.01, grey: float = 2.0) -> Arrays:
    """Return arrays with noise of a sensor: a share of the spread of numbers, and grey levels of pixels."""
    found = dict(arrays)
    for name, values in arrays.items():
        if values.dtype == np.uint8:
            drawn = random.standard_normal(values.shape, np.float32) * np.float32(grey)
            found[name] = np.clip(values + drawn, 0, 255).round().astype(np.uint8)
        elif values.dtype.kind == "f":
            spread = values.std(axis=0, keepdims=True)
            found[name] = (values + share * spread * random.standard_normal(values.shape)).astype(values.dtype)
    return found


def subjects(folder: Path) -> list[Subject]:
    """Return the four samples, and the tiny policy with a second camera."""
    found = []
    for name in SAMPLES:
        bundle = source_bundle(open_source(str(ROOT / "sample_models" / name)), folder / "cache", Context()).bundle
        whole, _ = evaluation_recording(bundle)
        calibration = recordings_of(bundle).calibration
        assert calibration is not None
        other = read_recording(calibration, bundle.manifest.spec)
        if whole.whole is not None:  # one recording for both: its halves are of different episodes
            other = other.subset(~np.isin(np.arange(len(other)), whole.indices))
        found.append(Subject(bundle, stream(whole), stream(other)))
    return [*found, _with_two_cameras(folder)]


def _with_two_cameras(folder: Path) -> Subject:
    source = source_bundle(open_source(str(write_policy(folder / "tiny"))), folder / "cache", Context()).bundle
    spec = source.manifest.spec
    wrist = replace(spec.inputs[0], name="wrist")
    copy = Path(shutil.copytree(source.path, folder / "two-cameras"))
    bundle = seal(copy, replace(source.manifest, spec=replace(spec, inputs=(*spec.inputs, wrist))))

    def drawn(seed: int) -> Arrays:
        arrays = observations(KNOTS, seed)
        arrays["wrist"] = observations(KNOTS, seed + 100)["image"]
        inputs = {tensor.name: arrays[tensor.name] for tensor in bundle.manifest.spec.inputs}
        return stream(build_recording(folder, inputs, bundle.manifest.spec, {}))

    return Subject(bundle, drawn(5), drawn(6))


@dataclass(frozen=True)
class Wrong:
    """A wrong wiring: arrays, or a bundle, that have it, and what must be found."""

    subject: Subject
    arrays: Arrays
    signals: tuple[str, ...]
    kind: str
    words: tuple[str, ...]

    def is_found(self, found: Sequence[Explanation]) -> bool:
        """Say whether this alone is found, and named."""
        named = {each.signal for each in found} == set(self.signals) and {each.kind for each in found} == {self.kind}
        return named and all(any(word in each.where for each in found) for word in self.words)


def plant(subject: Subject, kind: str, random: np.random.Generator) -> Wrong | None:
    """Return a wrong wiring of a kind, None where a policy cannot have it."""
    arrays, labels = dict(subject.stream), _labels(subject)
    pick = {"swapped": subject.images, "bgr": subject.images, "delayed": subject.images + subject.vectors}
    names = pick.get(kind, subject.vectors)
    if not names or (kind == "swapped" and len(names) < 2):
        return None
    name = str(random.choice(names))
    values = arrays[name]
    if kind == "bgr":
        tensor = next(each for each in subject.bundle.manifest.spec.inputs if each.name == name)
        change = next(change for (word, _), change in changes_of(tensor).items() if word == "bgr")
        return Wrong(subject, {**arrays, name: change(values)}, (name,), kind, ())
    if kind == "swapped":
        one, other = (str(each) for each in random.permutation(names)[:2])
        return Wrong(subject, {**arrays, one: arrays[other], other: arrays[one]}, (one, other), kind, (one, other))
    if kind == "delayed":
        steps = int(random.integers(1, 4))
        late = np.concatenate([np.repeat(values[:1], steps, axis=0), values[:-steps]])
        return Wrong(subject, {**arrays, name: late}, (name,), kind, (f"{steps} control step",))
    if kind == "statistics":
        return _with_statistics(subject, name, random)
    return _with_elements(subject, name, kind, labels[name], random)


def _labels(subject: Subject) -> Mapping[str, Sequence[str]]:
    return {tensor.name: tensor.labels or [f"[{index}]" for index in range(tensor.width)]
            for tensor in subject.bundle.manifest.spec.inputs}  # fmt: skip


def _with_elements(subject: Subject, name: str, kind: str, labels: Sequence[str], random: np.random.Generator) -> Wrong:
    values = subject.stream[name].copy()
    width = values.shape[1]
    some = random.permutation(width)[: int(random.integers(1, width + 1))]
    if kind == "permuted":
        order = random.permutation(width)
        while (order == np.arange(width)).all():
            order = random.permutation(width)
        words = tuple(f"{labels[at]} holds {labels[other]}" for at, other in enumerate(order) if at != other)
        values = values[:, order]
    elif kind == "negated":
        values[:, some] *= -1
        words = tuple(labels[index] for index in some) if len(some) < width else ("all elements",)
    else:
        factor = float(random.choice(list(FACTORS)))
        values[:, some] *= factor
        words = (FACTORS[factor],)
    return Wrong(subject, {**subject.stream, name: values}, (name,), kind, words)


def _with_statistics(subject: Subject, name: str, random: np.random.Generator) -> Wrong:
    """Normalise what is normalised again, or give the bundle statistics of another order, unit or sign."""
    file = subject.bundle.path / "assets/statistics.json"
    table = json.loads(file.read_text())
    mean, std = (np.array(table[name][key]) for key in ("mean", "std"))
    if random.random() < 0.5:
        values = ((subject.stream[name] - mean) / std).astype(np.float32)
        return Wrong(subject, {**subject.stream, name: values}, (name,), "statistics", ("normalised already",))
    way = int(random.integers(3))
    factor = [1000.0, 180 / math.pi, 1.0][way]
    shift = int(random.integers(1, len(mean))) if way == 2 else 0
    table[name] = {"mean": (factor * np.roll(mean, shift)).tolist(), "std": (factor * np.roll(std, shift)).tolist()}
    folder = Path(tempfile.mkdtemp(dir=subject.bundle.path.parent)) / "bundle"
    shutil.copytree(subject.bundle.path, folder)
    (folder / "assets/statistics.json").write_text(json.dumps(table))
    other = replace(subject, bundle=seal(folder, subject.bundle.manifest))
    return Wrong(other, subject.stream, (name,), "statistics", ("not of the recorded data",))


def right(subject: Subject, number: int, random: np.random.Generator) -> Recording:
    """Return a log of right wiring: more noise, other episodes, or a part of the episodes."""
    if number % 3 == 0:
        return subject.recording(noisy(subject.stream, random, 0.02 + 0.03 * random.random(), 2 + 4 * random.random()))
    if number % 3 == 1:
        return subject.recording(noisy(subject.other, random))
    first = int(random.integers(10, 100))
    part = {name: values[first : first + 120] for name, values in subject.stream.items()}
    return subject.recording(noisy(part, random), first=first)


def trials(wrong: int, right_logs: int, seed: int, folder: Path) -> tuple[Counter[str], Counter[str], list[str]]:
    """Return planted and found by kind (``right`` among them, found wrong), and a line for each miss."""
    random, policies = np.random.default_rng(seed), subjects(folder)
    planted, found, misses = Counter[str](), Counter[str](), list[str]()
    for number in range(wrong):
        kind = KINDS[number % len(KINDS)]
        case = None
        while case is None:
            case = plant(policies[int(random.integers(len(policies)))], kind, random)
        log = case.subject.recording(noisy(case.arrays, random))
        explanations = _explain(case.subject, log)
        planted[kind] += 1
        found[kind] += case.is_found(explanations)
        if not case.is_found(explanations):
            misses.append(_line(case.subject, f"{kind} {case.signals} {case.words}", explanations))
    for number in range(right_logs):
        subject = policies[number % len(policies)]
        explanations = _explain(subject, right(subject, number, random))
        planted["right"] += 1
        found["right"] += bool(explanations)
        misses += [_line(subject, f"right, way {number % 3}", explanations)] if explanations else []
    return planted, found, misses


def _explain(subject: Subject, log: Recording) -> Sequence[Explanation]:
    return explain_inputs(subject.bundle, log, [subject.recording(subject.stream)], own=True)[0].explanations


def _line(subject: Subject, what: str, found: Sequence[Explanation]) -> str:
    return f"{subject.bundle.manifest.name}: {what}: " + ("; ".join(each.sentence() for each in found) or "nothing")


def _elsewhere(asked: Any) -> int:
    """Print the tables and every miss of logs of other episodes."""
    with tempfile.TemporaryDirectory() as folder:
        recordings = asked.recordings or Path(folder) / "recordings"
        policies = wiring_elsewhere.subjects(recordings, Path(folder), asked.policies)
        table, lines = wiring_elsewhere.trials(policies, asked.wrong, asked.right, asked.seed)
    text, enough = wiring_elsewhere.summary(table)
    print("\n".join([*lines, text]))
    return int(not enough)


def main() -> int:
    """Print the table by kind and every miss."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wrong", type=int, default=500)
    parser.add_argument("--right", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", choices=("same", "other"), default="same")
    parser.add_argument("--recordings", type=Path, help="folder that keeps the simulated recordings of other episodes")
    parser.add_argument("--policies", nargs="*", default=list(wiring_recordings.SEEDS), help="of other episodes")
    asked: Any = parser.parse_args()
    if asked.episodes == "other":
        return _elsewhere(asked)
    with tempfile.TemporaryDirectory() as folder:
        planted, found, misses = trials(asked.wrong, asked.right, asked.seed, Path(folder))
    print("\n".join(misses))
    for kind, count in planted.items():
        print(f"{kind:12} {found[kind]:4} of {count:4}")
    wrong = sum(count for kind, count in planted.items() if kind != "right")
    named = sum(count for kind, count in found.items() if kind != "right")
    print(f"{named} of {wrong} wrong wirings named ({named / wrong:.1%}), {found['right']} right logs found wrong")
    return int(named < 0.95 * wrong or found["right"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
