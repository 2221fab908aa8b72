"""Score the whole fit: scales, figures and intervals are found without the rows that are then predicted."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.errors import DataError, UsageError
from vlatool.files.messages import from_json, to_json
from vlatool.latency_model.fit import fit
from vlatool.latency_model.model import LatencyModel, Prediction
from vlatool.latency_model.published_latencies import Point, merge_versions, read_points
from vlatool.latency_model.score import DRAWS, FOLDS, describe_split, summarize
from vlatool.machine.processes import single_threads
from vlatool.user_code.children import OnProgress, map_jobs

PredictedPoints = list[tuple[Point, Prediction]]


def refit_points(
    path: Path, held_out: str | None, seed: int, seconds: float, tell: OnProgress
) -> dict[str, dict[str, Any]]:
    """Predict a file's rows with models that were fitted without them, in one process for each core.

    Left-out rows have no influence at all: not on the scales, which start at built-in values, not on the figures, and
    not on the intervals.

    Args:
        held_out: ``models``: a tenth of the models at a time; ``devices``: each board.
        seed: Random seed of the folds, of the search, and of the calibrating models.
        seconds: Time limit of the search of each part.

    Returns:
        ``models``; or ``devices`` and ``calibrated``, where a board is left out except for one of its models.

    Raises:
        UsageError: when ``held_out`` is unknown.
        DataError: when the file is malformed, or no rows are left to fit on.
    """
    if held_out not in KINDS:
        got = "not given" if held_out is None else f"'{held_out}'"
        raise UsageError(
            f"--held-out is {got}; with --refit, allowed: models, devices (which tells calibrated, too).",
            "pass --held-out models or --held-out devices",
        )
    points = read_points(path)
    folds = deal_folds([point for point in points if point.question], held_out, seed)
    if len(folds) < 2:
        raise DataError(
            f"{path} has fewer than two {held_out}: nothing is left to fit on.",
            f"add rows of further {held_out}, or hold out something else",
        )
    answered: dict[str, PredictedPoints] = {kind: [] for kind in KINDS[held_out]}
    how = {"points": str(path.absolute()), "held_out": held_out, "seed": seed, "seconds": seconds}
    jobs = [{**how, "held": sorted(held)} for held in folds]
    processes = len(os.sched_getaffinity(0))
    parts = map_jobs(f"{__name__}:fold", jobs, processes, tell, "the fit", (__name__,))
    with single_threads(), contextlib.closing(parts):
        for done, part in enumerate(parts, 1):
            for kind, rows in part.items():
                answered[kind] += [(points[number], from_json(Prediction, values)) for number, values in rows]
            tell(f"{done} of {len(jobs)} parts left out", done / len(jobs))
    unasked = [point for point in points if not point.question]
    summaries = {}
    for kind, pairs in answered.items():
        predictions = [prediction for _, prediction in pairs]
        about = f"{describe_split(kind, seed)}; all fitted anew without it, {seconds:g} s each"
        summaries[kind] = summarize([point for point, _ in pairs] + unasked, predictions, about)
    return summaries


KINDS = {"models": ("models",), "devices": ("devices", "calibrated")}


def deal_folds(points: Sequence[Point], held_out: str, seed: int) -> list[frozenset[str]]:
    """Return the names of the models, or of the boards, that are left out together."""
    if held_out != "models":
        return [frozenset({name}) for name in sorted({point.group for point in points})]
    names = sorted({point.model for point in points})
    order = np.random.default_rng(seed).permutation(len(names))
    parts = [frozenset(names[index] for index in order[number::FOLDS]) for number in range(FOLDS)]
    return [part for part in parts if part]


def fold(job: Mapping[str, Any], _tell: OnProgress) -> dict[str, Any]:
    """Compute one part in this process: kind -> index of the point and its prediction."""
    points = read_points(Path(job["points"]))
    numbers = {id(point): number for number, point in enumerate(points)}
    answered = one_fold(points, frozenset(job["held"]), job["held_out"], job["seed"], job["seconds"])
    return {kind: [[numbers[id(point)], to_json(answer)] for point, answer in part] for kind, part in answered.items()}


def one_fold(
    points: Sequence[Point], held: frozenset[str], held_out: str, seed: int, seconds: float
) -> dict[str, PredictedPoints]:
    """Return the predictions of a model that was fitted without some models or boards, for these."""

    def out(point: Point) -> bool:
        return (point.model if held_out == "models" else point.group) in held

    mine = [point for point in points if out(point) and point.question]
    model = fit([point for point in points if not out(point)], None, seconds, seed, lambda _: None)
    answered = {held_out: predict_points(model, mine)}
    if held_out == "devices":
        random = np.random.default_rng(seed)
        names = sorted({point.model for point in mine})
        answered["calibrated"] = []
        for _ in range(DRAWS):
            known = names[random.integers(len(names))]
            measured = merge_versions(point for point in mine if point.model == known)
            conditioned = model.condition(
                [(point.question, float(np.exp(point.log_ms))) for point in measured if point.question]
            )
            answered["calibrated"] += predict_points(conditioned, [point for point in mine if point.model != known])
    return answered


def predict_points(model: LatencyModel, points: Sequence[Point]) -> PredictedPoints:
    """Return the predictions of a model for some points."""
    return list(zip(points, model.predict([point.question for point in points if point.question]), strict=True))
