"""Predictions of published latencies with their model, or their device, left out.

Leaving a group out of a Gaussian process needs no second fit: with A the inverse of the covariance of all rows, the
group's mean is y_g - inv(A_gg) (A y)_g and its covariance inv(A_gg) (Rasmussen and Williams 2006, section 5.4.2).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vlatool.latency_model.features import Question
from vlatool.latency_model.gaussian_process import Rows, Scales, kernel
from vlatool.latency_model.published_latencies import Point, merge_versions
from vlatool.runtime.interface import Array

UNITS = ("cpu", "gpu", "igpu", "npu")
MAX_MODELS = 32
"""Largest number of models that calibrate a held-out device, one at a time."""


@dataclass(frozen=True)
class Sample:
    """The rows of a fit.

    Args:
        logs: (n,) natural logarithm of ms.
        models, devices: (n,) codes of the groups that are left out as a whole.
        units: (n,) index into ``UNITS``.
        figures: (m,) row of each published figure: several versions of a runtime share a row.
        published: (m,) logarithms of the figures.
    """

    questions: tuple[Question, ...]
    logs: Array
    models: Array
    devices: Array
    units: Array
    figures: Array
    published: Array

    @staticmethod
    def from_points(points: Sequence[Point]) -> Sample:
        """Return a sample of the predictable points, one row for each question."""
        asked = [point for point in points if point.question is not None]
        known = merge_versions(asked)
        row = {point.question: index for index, point in enumerate(known)}
        figures = np.array([row[point.question] for point in asked], np.int64)
        published = np.array([point.log_ms for point in asked])
        models, devices = (
            np.unique([getattr(point, name) for point in known], return_inverse=True)[1] for name in ("model", "group")
        )
        units = np.array([UNITS.index(point.kind) for point in known])
        questions = tuple(point.question for point in known if point.question is not None)
        logs = np.array([point.log_ms for point in known])
        return Sample(questions, logs, models, devices, units, figures, published)


class Folds:
    """Predictions of each row without its group."""

    def __init__(self, rows: Rows, sample: Sample, scales: Scales) -> None:
        covariance = kernel(rows, rows, scales)
        covariance[np.diag_indices(len(rows))] += scales.noise**2
        self._inverse = np.linalg.inv(covariance)
        self._residual = sample.logs - rows.prior
        self._weights = self._inverse @ self._residual
        self._sample = sample

    def leave_out(self, groups: Array) -> tuple[Array, Array]:
        """Return error of log(ms) (predicted minus measured) and its predicted standard deviation for each row."""
        error, deviation = np.zeros(len(groups)), np.zeros(len(groups))
        for index, mean, covariance in self._left_out_groups(groups):
            error[index], deviation[index] = mean - self._residual[index], np.sqrt(np.diag(covariance))
        return error, deviation

    def leave_out_calibrated(self, groups: Array, limit: int = MAX_MODELS) -> tuple[Array, Array, Array, Array]:
        """Leave each device out, condition on one of its models, and predict the others; for many of its models.

        Args:
            groups: Codes of the devices.
            limit: Largest number of calibrating models of each device.

        Returns:
            Errors, standard deviations, their rows, and the index of the calibration of each.
        """
        errors: list[Array] = []
        deviations: list[Array] = []
        rows: list[Array] = []
        for index, mean, covariance in self._left_out_groups(groups):
            models = np.unique(self._sample.models[index])
            for model in models[:: max(1, -(-len(models) // limit))]:
                observed = self._sample.models[index] == model
                if not observed.all():
                    error, deviation = self._errors_given(observed, index, mean, covariance)
                    errors.append(error)
                    deviations.append(deviation)
                    rows.append(index[~observed])
        if not errors:  # every device has only one model
            return np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64)
        draws = np.repeat(np.arange(len(rows)), [len(part) for part in rows])
        return np.concatenate(errors), np.concatenate(deviations), np.concatenate(rows), draws

    def leave_out_once(self, groups: Array, random: np.random.Generator) -> tuple[Array, Array, Array]:
        """Leave each device out, condition on one of its models, drawn at random, and predict the others.

        Returns:
            Error and standard deviation of each row, and the mask of calibrating rows.
        """
        error, deviation = np.zeros(len(groups)), np.ones(len(groups))
        calibrating = np.zeros(len(groups), bool)
        for index, mean, covariance in self._left_out_groups(groups):
            models = np.unique(self._sample.models[index])
            observed = self._sample.models[index] == models[random.integers(len(models))]
            calibrating[index[observed]] = True
            if not observed.all():
                others = index[~observed]
                error[others], deviation[others] = self._errors_given(observed, index, mean, covariance)
        return error, deviation, calibrating

    def _errors_given(self, observed: Array, index: Array, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Return error and standard deviation of a group's other rows, conditioned on the observed ones."""
        residual, rest = self._residual[index], ~observed
        across = covariance[np.ix_(rest, observed)] @ np.linalg.inv(covariance[np.ix_(observed, observed)])
        error = mean[rest] + across @ (residual[observed] - mean[observed]) - residual[rest]
        spread = np.diag(covariance)[rest] - np.einsum("ij,ij->i", across, covariance[np.ix_(rest, observed)])
        return error, np.sqrt(np.maximum(spread, 1e-9))

    def _left_out_groups(self, groups: Array) -> Iterator[tuple[Array, Array, Array]]:
        for code in np.unique(groups):
            index = np.flatnonzero(groups == code)
            covariance = np.linalg.inv(self._inverse[np.ix_(index, index)])
            yield index, self._residual[index] - covariance @ self._weights[index], covariance
