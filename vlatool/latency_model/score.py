"""Errors of predictions of published latencies, and the coverage of their intervals."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import DataError, UsageError, fix_for
from vlatool.latency_model.features import rows_of
from vlatool.latency_model.fit import Scores, split_by_part
from vlatool.latency_model.folds import UNITS, Folds, Sample
from vlatool.latency_model.model import LEVEL, MAX_HALF_INTERVAL, MODEL_ENV, Prediction, load_model, unknown_reason
from vlatool.latency_model.published_latencies import Point, read_points
from vlatool.runtime.interface import Array

SPLITS = ("models", "devices", "calibrated")
DRAWS = 5
"""Number of models that calibrate each device, one at a time."""
FOLDS = 10
"""Number of folds of the models; one fold is left out at a time. Devices are left out one at a time."""


def score_points(path: Path, held_out: str | None = None, seed: int = 0) -> dict[str, Any]:
    """Predict a file; with ``held_out`` from its own other rows.

    Args:
        held_out: ``models``: a tenth of the models is left out at a time; ``devices``: each device; ``calibrated``:
            each device except for one of its models. The widths of the intervals come from the errors of the others,
            whose predictions used the rows that are left out here; ``refit`` is stricter.
            None: the shipped model predicts every row.
        seed: Random seed of the folds, and of the calibrating models.

    Raises:
        UsageError: when ``held_out`` is unknown.
        DataError: when the file is malformed, or the model has no data for its kind of unit.
    """
    points = read_points(path)
    own = os.environ.get(MODEL_ENV)
    whose = f"the model of {own}" if own else "the shipped model"
    if held_out is None:
        predictions = load_model().predict([point.question for point in points if point.question])
        return summarize(points, predictions, whose)
    if held_out not in SPLITS:
        raise UsageError(f"--held-out is '{held_out}'; allowed: {', '.join(SPLITS)}.", fix_for(held_out, SPLITS))
    scored: list[Point] = []
    answers: list[Prediction] = []
    for draw in range(DRAWS if held_out == "calibrated" else 1):
        known: dict[Any, Prediction] = {}
        for part, mine in split_by_part(points).items():
            if mine:
                known.update(_predict_left_out(Sample.from_points(mine), part, held_out, seed + 1000 * draw))
        drawn = [point for point in points if not point.question or known[point.question].regime != "told"]
        answers += [known[point.question] for point in drawn if point.question]
        scored += drawn
    return summarize(scored, answers, f"{describe_split(held_out, seed)}; scales of {whose}")


def describe_split(held_out: str, seed: int) -> str:
    """Return a description of the left-out rows."""
    return {
        "models": f"{FOLDS} folds of whole models, dealt with seed {seed}",
        "devices": "each device left out whole",
        "calibrated": f"each device left out but for one model, {DRAWS} times, chosen with seed {seed}",
    }[held_out]


def _predict_left_out(sample: Sample, part: str, held_out: str, seed: int) -> dict[Any, Prediction]:
    """Return question -> prediction from the rows that are not left out with it."""
    model = load_model()
    if part not in model.parts:
        raise DataError(f"The latency model has no figures of {part}, and so no scales for them.", f"unset {MODEL_ENV}")
    rows = rows_of(sample.questions, model.shares[part])
    folds = Folds(rows, sample, model.parts[part].scales)
    random = np.random.default_rng(seed)
    calibrating = np.zeros(len(sample.logs), bool)
    groups = sample.devices
    if held_out == "models":
        groups = (random.permutation(sample.models.max() + 1) % FOLDS)[sample.models]
    if held_out == "calibrated":
        error, deviation, calibrating = folds.leave_out_once(groups, random)
        scores = Scores.for_calibrated(sample, folds)
    else:
        error, deviation = folds.leave_out(groups)
        draws = sample.models if held_out == "models" else rows.keys["pair"]
        scores = Scores.for_sample(sample, error, deviation, groups, draws)
    regime = {"models": "known", "devices": "unseen", "calibrated": "calibrated"}[held_out]
    reach = {pair: scores.quantile(pair[1], pair[0]) for pair in set(zip(groups, sample.units, strict=True))}
    unknown = _unknown_runtimes(sample, groups, calibrating)
    predictions: dict[Any, Prediction] = {}
    for index, question in enumerate(sample.questions):
        half = reach[groups[index], sample.units[index]] * deviation[index]
        why = unknown_reason(question, not unknown[index], regime != "unseen")
        if not why and half > MAX_HALF_INTERVAL:
            why = "published figures leave too wide an interval"
        if calibrating[index]:
            predictions[question] = Prediction(math.nan, regime="told", why=why or "it was told")
        elif why:
            predictions[question] = Prediction(math.nan, regime=regime, why=why)
        else:
            predictions[question] = Prediction.between(sample.logs[index] + error[index], half, regime)
    return predictions


def _unknown_runtimes(sample: Sample, groups: Array, calibrating: Array) -> Array:
    """Return the mask of rows whose runtime occurs in no other group and does not calibrate: it is unknown."""
    runtimes = np.array([question.runtime for question in sample.questions])
    unknown = np.zeros(len(runtimes), bool)
    for runtime in np.unique(runtimes):
        rows = runtimes == runtime
        unknown[rows] = len(np.unique(groups[rows])) < 2 and not calibrating[rows].any()
    return unknown


def summarize(points: Sequence[Point], answers: Sequence[Prediction], how: str) -> dict[str, Any]:
    """Return the errors of predictions, as JSON values."""
    asked = [point for point in points if point.question]
    why: Counter[str] = Counter()
    why.update(point.why for point in points if not point.question)
    why.update(answer.why for answer in answers if answer.why)
    known = [(point, answer) for point, answer in zip(asked, answers, strict=True) if answer.known]
    groups = {"all but npu": [pair for pair in known if pair[0].kind != "npu"]}
    groups |= {unit: [pair for pair in known if pair[0].kind == unit] for unit in UNITS}
    return {
        "how": how, "rows": len(points), "predicted": len(known), "level": LEVEL,
        "groups": {name: _errors(pairs) for name, pairs in groups.items() if pairs},
        "unknown": dict(sorted(why.items(), key=lambda item: -item[1])),
    }  # fmt: skip


def _errors(pairs: Sequence[tuple[Point, Prediction]]) -> dict[str, float]:
    measured = np.exp([point.log_ms for point, _ in pairs])
    predicted, low, high = (np.array([getattr(answer, name) for _, answer in pairs]) for name in ("ms", "low", "high"))
    off = np.abs(predicted / measured - 1)
    inside = (low <= measured) & (measured <= high)
    return {
        "rows": len(pairs), "median": float(np.median(off)), "p90": float(np.quantile(off, 0.9)),
        "coverage": float(inside.mean()), "factor": float(np.exp(np.median(np.log(high / low)) / 2)),
    }  # fmt: skip


def summary_lines(scored: Mapping[str, Any]) -> Iterator[str]:
    """Return the summary as lines of text."""
    yield f"{scored['how']}"
    yield f"{scored['predicted']} of {scored['rows']} rows predicted; relative error |predicted - measured| / measured"
    yield f"{'':14}{'rows':>6}{'median':>9}{'90th pct':>10}{'in interval':>13}{'interval':>10}"
    for name, figures in scored["groups"].items():
        yield (
            f"{name:14}{figures['rows']:>6}{figures['median']:>9.1%}{figures['p90']:>10.1%}{figures['coverage']:>13.1%}"
            f"{'x/÷ ' + format(figures['factor'], '.2f'):>10}"
        )
    yield f"The interval is meant to hold {scored['level']:.0%}."
    for reason, count in list(scored["unknown"].items())[:12]:
        yield f"  unknown, {count}: {reason}"
