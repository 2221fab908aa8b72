"""What ``export`` and ``quantize`` print about a bundle for a board: size, predictions, and how its actions differ."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import VlatoolError
from vlatool.hardware.profile import Profile
from vlatool.measures.actions import AGREEMENT_BASELINE, RELATIVE_ERROR
from vlatool.measures.latency import LATENCY_P50
from vlatool.measures.resources import MEMORY
from vlatool.report import Measurement
from vlatool.stage.base import Context

SAMPLES = 64
"""Recorded observations that the actions are compared on."""
SMALLER = 1.05
"""Smallest ratio at which a bundle is reported as smaller than its source."""
WORDS_OF = {quantity.name: quantity.words for quantity in (LATENCY_P50, MEMORY)}


@dataclass(frozen=True)
class BoardSummary:
    """A new bundle beside the one that it was made from.

    Args:
        board: Name of the profile.
        before, after: Bytes of the graphs; before is None where the source has no graphs.
        predictions: Predictions for the board, with their intervals.
        error: How the actions differ from the source's on recorded observations, None where that cannot be said.
        missing: What could not be predicted or compared, and why, in words.
    """

    board: str
    before: int | None
    after: int
    predictions: tuple[Measurement, ...]
    error: Measurement | None
    missing: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return what a person wants to know."""
        predicted = [
            f"{WORDS_OF[number.name]} on {self.board}, predicted: {_number(number)}" for number in self.predictions
        ]
        error = [_error_text(self.error)] if self.error is not None else []
        return [*([self._size()] if self.after else []), *predicted, *error, *self.missing]

    def _size(self) -> str:
        after = f"{self.after / 1e6:.2f} MB"
        if self.before is None:
            return f"graphs {after}"
        smaller = self.before / self.after
        ratio = f", {smaller:.1f}x smaller" if smaller >= SMALLER else ""
        return f"graphs {self.before / 1e6:.2f} MB -> {after}{ratio}"

    def values(self) -> dict[str, Any]:
        """Return the same as JSON values."""
        numbers = {number.name: {"value": number.value, "low": number.low, "high": number.high, "unit": number.unit,
                                 "note": number.note} for number in self.predictions}  # fmt: skip
        error = None if self.error is None else {"name": self.error.name, "value": self.error.value}
        return {"board": self.board, "graphs_before": self.before, "graphs_after": self.after, "predictions": numbers,
                "actions": error, "missing": [*self.missing]}  # fmt: skip


def board_summary(bundle: Bundle, source: Bundle | None, profile: Profile, context: Context) -> BoardSummary:
    """Compare a new bundle with its source, and predict it on a board.

    The bundle is written by now: what cannot be predicted or compared is listed, and does not fail the command.
    """
    missing: list[str] = []
    numbers: tuple[Measurement, ...] = ()
    error = None
    if bundle.manifest.graphs:
        context.progress(f"predicting for {profile.name}", None)
        with _noting(missing, f"nothing is predicted for {profile.name}"):
            from vlatool.latency_model.predict import predictions

            numbers = tuple(number for number in predictions(profile, bundle) if number.name in WORDS_OF)
        with _noting(missing, "the actions were not compared with the source's"):
            error = _error(bundle, source, context)
    else:
        missing.append(f"predicted for {profile.name} once it is exported: vlatool export --profile {profile.name}")
    before = source.graph_bytes if source is not None and source.manifest.graphs else None
    return BoardSummary(profile.name, before, bundle.graph_bytes, numbers, error, tuple(missing))


@contextlib.contextmanager
def _noting(missing: list[str], what: str) -> Iterator[None]:
    try:
        yield
    except VlatoolError as error:
        missing.append(f"{what}: {error.message}")


def _error(bundle: Bundle, source: Bundle | None, context: Context) -> Measurement | None:
    from vlatool.data import carries_evaluation
    from vlatool.evaluate.recorded import Recorded

    if source is None or not source.manifest.graphs or not carries_evaluation(bundle):
        return None
    row = Recorded(baseline=source.path, samples=SAMPLES).run(bundle, context).rows[-1]
    error = row.get(AGREEMENT_BASELINE) or row.get(RELATIVE_ERROR)
    return error if error is not None and error.known else None


def _error_text(error: Measurement) -> str:
    of = f"{error.samples} recorded observations"
    if error.name == AGREEMENT_BASELINE.name:
        return f"the same actions as the source: {error.value:.1%} of {of}"
    return f"relative error of the actions: {error.value:.3g} against the source, on {of}"


def _number(number: Measurement) -> str:
    if not number.known:
        return number.note or "not known"
    low, high = number.low, number.high
    interval = f" ({_digits(low)} to {_digits(high)})" if low is not None and high is not None else ""
    return f"{_digits(number.value)} {number.unit}{interval}"


def _digits(value: float) -> str:
    """Return three digits, or more where the number has more before the point."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:,.0f}"
