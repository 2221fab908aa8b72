"""Latency of a graph on a board: a prediction with an interval, or the reason why it is unknown."""

from __future__ import annotations

import functools
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import DataError
from vlatool.files.messages import to_json
from vlatool.files.user_files import atomic_file
from vlatool.latency_model.features import PROXIES, Question, Shares, rows_of
from vlatool.latency_model.gaussian_process import KEYS, PARTS, Process, Rows, Scales
from vlatool.runtime.interface import Array

DATA = Path(__file__).with_name("data")
MODEL_ENV = "VLATOOL_LATENCY"
"""Environment variable with a directory of ``vlatool hwselect fit``."""
LEVEL = 0.8
"""Share of measurements inside the interval."""
MAX_HALF_INTERVAL = 1.4
"""Largest useful half width of an interval in log(ms): a factor of 4 in either direction."""


@dataclass(frozen=True)
class Prediction:
    """Milliseconds of one run.

    Args:
        ms: Median; NaN when unknown.
        low, high: Interval with ``LEVEL`` of measurements.
        regime: ``known`` (this runtime and precision were measured on this device), ``calibrated`` (the user measured
            something there), ``unseen``.
        why: Reason why it is unknown; empty when it is known.
    """

    ms: float
    low: float = math.nan
    high: float = math.nan
    regime: str = "unseen"
    why: str = ""

    @classmethod
    def between(cls, log_ms: float, half: float, regime: str) -> Prediction:
        """Return a prediction from the logarithm of its median and the half width of its interval in log(ms)."""
        ms = math.exp(log_ms)
        return cls(ms, ms * math.exp(-half), ms * math.exp(half), regime)

    @property
    def known(self) -> bool:
        """Whether there is a prediction."""
        return not self.why


@dataclass(frozen=True)
class TrainingData:
    """Data of a process: figures and scales, with the natural logarithms of the ms in ``logs``, (n,)."""

    rows: Rows
    logs: Array
    scales: Scales

    def process_without(self, runtimes: Iterable[int]) -> Process:
        """Return the process without the figures of some runtimes (codes of ``KEYS``)."""
        kept = ~np.isin(self.rows.keys["runtime"], sorted(runtimes))
        return Process(self.rows.take(kept), self.logs[kept], self.scales)


MAX_IDLE_FIGURES = 900
"""Number of figures above which a runtime is left out when no question is about it."""


def crowded_runtimes(rows: Rows) -> set[int]:
    """Return the runtimes (codes of ``KEYS``) with very many figures."""
    codes, counts = np.unique(rows.keys["runtime"], return_counts=True)
    return {int(code) for code in codes[counts > MAX_IDLE_FIGURES]}


@dataclass
class LatencyModel:
    """Two processes: one for processors and GPUs, one for neural processing units.

    Args:
        parts: ``processors`` and ``npu`` -> data of the process.
        shares: The same -> shares of the roofline.
        conformal: The same -> regime -> unit -> half width of the interval in standard deviations.
        about: Description of the fit, for reports.
        own: Codes of the devices (of ``KEYS``) that the user measured.
    """

    parts: Mapping[str, TrainingData]
    shares: Mapping[str, Shares]
    conformal: Mapping[str, Mapping[str, Mapping[str, float]]]
    about: Mapping[str, Any]
    own: frozenset[int] = field(default_factory=frozenset)
    _processes: dict[tuple[str, frozenset[int]], Process] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _condition_cache: tuple[Sequence[tuple[Question, float]], LatencyModel] | None = field(
        default=None, init=False, repr=False, compare=False
    )

    def predict(self, questions: Sequence[Question]) -> list[Prediction]:
        """Return the prediction for every question, in order."""
        answers = [Prediction(math.nan, why="the latency model has no figures of such a unit")] * len(questions)
        for part in self.parts:
            indices = [index for index, question in enumerate(questions) if part_of(question) == part]
            predictions = self._predict(part, [questions[index] for index in indices])
            for index, answer in zip(indices, predictions, strict=True):
                answers[index] = answer
        return answers

    def condition(self, measured: Sequence[tuple[Question, float]]) -> LatencyModel:
        """Return the model with a user's measurements added: (question, ms); the same object for the same figures.

        Its processes, about a second of work, are therefore built once in a command, for any number of bundles.
        """
        if not measured:
            return self
        if self._condition_cache is None or self._condition_cache[0] != measured:
            self._condition_cache = (measured, self._condition(measured))
        return self._condition_cache[1]

    def _condition(self, measured: Sequence[tuple[Question, float]]) -> LatencyModel:
        parts = dict(self.parts)
        own = set(self.own)
        for part, known in self.parts.items():
            mine = [(question, ms) for question, ms in measured if part_of(question) == part]
            if not mine:
                continue
            rows = rows_of([question for question, _ in mine], self.shares[part])
            logs = np.log([ms for _, ms in mine])
            parts[part] = TrainingData(Rows.concatenate(known.rows, rows), np.append(known.logs, logs), known.scales)
            own.update(rows.keys["device"].tolist())
        return LatencyModel(parts, self.shares, self.conformal, self.about, frozenset(own))

    def _predict(self, part: str, questions: list[Question]) -> list[Prediction]:
        if not questions:
            return []
        known = self.parts[part]
        rows = rows_of(questions, self.shares[part])
        mean, deviation = self._process(part, rows).predict(rows)
        pairs, runtimes = (set(known.rows.keys[name].tolist()) for name in ("pair", "runtime"))
        answers = []
        for number, question in enumerate(questions):
            regime = "known" if int(rows.keys["pair"][number]) in pairs else "unseen"
            if int(rows.keys["device"][number]) in self.own:
                regime = "calibrated"
            spans = self.conformal[part][regime]
            half = float(spans.get(question.compute_unit.unit, max(spans.values())) * deviation[number])
            why = unknown_reason(question, int(rows.keys["runtime"][number]) in runtimes, regime != "unseen")
            if not why and half > MAX_HALF_INTERVAL:
                why = f"published figures leave a factor of {math.exp(half):.1f} either way; measure it on the board"
            unknown = Prediction(math.nan, regime=regime, why=why)
            answers.append(unknown if why else Prediction.between(mean[number], half, regime))
        return answers

    def _process(self, part: str, rows: Rows) -> Process:
        """Return the process for some questions.

        A runtime with very many figures that no question is about is left out: it says next to nothing about the
        others, and the cost grows with the third power of the figures.
        """
        unasked = frozenset(crowded_runtimes(self.parts[part].rows) - set(rows.keys["runtime"].tolist()))
        if (part, unasked) not in self._processes:
            self._processes[part, unasked] = self.parts[part].process_without(unasked)
        return self._processes[part, unasked]


UNKNOWN_NPU = "figures of one neural processing unit say too little about another; measure it on the board"


def part_of(question: Question) -> str:
    """Return the part that answers a question."""
    return "npu" if question.compute_unit.unit == "npu" else "processors"


def unknown_reason(question: Question, published: bool, device_known: bool) -> str:
    """Return why a question cannot be answered, or an empty string.

    Args:
        published: Whether a figure of the runtime is known.
        device_known: Whether a figure of this device is known.
    """
    if question.runtime == "hailort" and "attention" in question.work.traits:
        return "Hailo's published figures are of convolutional networks; a transformer's latency there is unknown"
    precision = PROXIES.get(question.precision, question.precision)
    if question.compute_unit.unit == "npu" and precision in ("float32", "w4", "w8"):
        return f"the unit does not compute in {question.precision}"
    if not published:
        return f"no latency was published for the runtime {question.runtime}"
    return UNKNOWN_NPU if question.compute_unit.unit == "npu" and not device_known else ""


def load_model() -> LatencyModel:
    """Return the model of the package, or of ``$VLATOOL_LATENCY``; raises DataError when its files cannot be read."""
    own = os.environ.get(MODEL_ENV)
    try:
        return read_model(Path(own) if own else DATA)
    except READ_ERRORS as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        refit = f"unset {MODEL_ENV}, or make one: vlatool hwselect fit POINTS.csv -o DIR"
        fix = refit if own else "install vlatool again"
        raise DataError(f"The latency model in {own or DATA} cannot be read: {reason}.", fix) from error


READ_ERRORS = (
    OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Exceptions of reading a file in another format."""


@functools.cache
def read_model(folder: Path) -> LatencyModel:
    """Return the model of a directory that ``write`` wrote; read once in a process."""
    parameters = json.loads((folder / "latency.json").read_text(encoding="utf-8"))
    parts, shares = {}, {}
    with (folder / "latency.npz").open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
        for part, values in parameters["parts"].items():
            arrays = {name: stored[f"{part}.{name}"] for name in PARTS}
            keys = stored[f"{part}.keys"]
            if keys.ndim != 2 or keys.shape[1] != len(KEYS):
                raise ValueError("it was fitted by another version of vlatool")
            rows = Rows({name: keys[:, column].astype(np.int64) for column, name in enumerate(KEYS)},
                        **{name: array.astype(float) for name, array in arrays.items()})  # fmt: skip
            parts[part] = TrainingData(rows, stored[f"{part}.logs"].astype(float), Scales(**values["scales"]))
            shares[part] = Shares(**values["shares"])
    if not parts:
        raise ValueError("it has no part")
    conformal = {part: values["conformal"] for part, values in parameters["parts"].items()}
    return LatencyModel(parts, shares, conformal, parameters["about"])


def write(model: LatencyModel, folder: Path) -> None:
    """Write ``latency.npz`` and ``latency.json`` as ``load_model`` reads them."""
    arrays: dict[str, Array] = {}
    described: dict[str, Any] = {}
    for part, known in model.parts.items():
        rows = known.rows
        arrays[f"{part}.keys"] = np.stack([rows.keys[name] for name in KEYS], axis=1).astype(np.uint32)
        for name in PARTS:
            arrays[f"{part}.{name}"] = getattr(rows, name).astype(np.float32)
        arrays[f"{part}.logs"] = known.logs.astype(np.float32)
        described[part] = {
            "scales": {key: float(f"{value:.5g}") for key, value in to_json(known.scales).items()},
            "shares": {key: float(f"{value:.5g}") for key, value in to_json(model.shares[part]).items()},
            "conformal": {
                regime: {unit: round(value, 4) for unit, value in units.items()}
                for regime, units in model.conformal[part].items()
            },
        }
    text = json.dumps({"about": dict(model.about), "parts": described}, indent=1)
    with atomic_file(folder / "latency.npz") as stored, atomic_file(folder / "latency.json") as text_file:
        with stored.open("wb") as stream:  # by its name numpy would call it .npz
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        text_file.write_text(text + "\n", encoding="utf-8")
