"""A Gaussian process over the logarithm of latency: nearby published figures determine a prediction.

    log(ms) = log(roofline) + f,   f ~ GP(0, K)

K is a sum of components: some are shared by all rows of one runtime, device, precision or model; some vary smoothly
with the features of model and device (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapters 2
and 5). A measurement on a board is one more point: calibration conditions on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from vlatool.runtime.interface import Array

KEYS = ("unit", "core", "device", "runtime", "kind", "made", "line", "pair", "setting", "model", "known")
"""Categories of a row: class of unit; instruction set of its cores; device and unit; runtime; runtime and precision;
instruction set, runtime and precision; device, unit and runtime; these and precision; all that and power mode, threads,
version; model; model, runtime and precision."""


@dataclass(frozen=True)
class Rows:
    """Questions or measurements.

    Args:
        keys: Category of ``KEYS`` -> (n,) int64.
        model: (n, 4) float: see ``_features``.
        traits: (n, 5) 0 or 1.
        device: (n, 4) float.
        prior: (n,) logarithm of the roofline in ms.
    """

    keys: Mapping[str, Array]
    model: Array
    traits: Array
    device: Array
    prior: Array

    def __len__(self) -> int:
        return len(self.prior)

    def take(self, index: Any) -> Rows:
        """Return some of the rows."""
        keys = {name: values[index] for name, values in self.keys.items()}
        return Rows(keys, self.model[index], self.traits[index], self.device[index], self.prior[index])

    @staticmethod
    def concatenate(first: Rows, second: Rows) -> Rows:
        """Return the rows of both."""
        keys = {name: np.concatenate([first.keys[name], second.keys[name]]) for name in KEYS}
        rest = (np.concatenate([getattr(first, name), getattr(second, name)]) for name in PARTS)
        return Rows(keys, *rest)


PARTS = tuple(field.name for field in fields(Rows))[1:]


@dataclass(frozen=True)
class Scales:
    """Parameters of the fit: standard deviations of the components in log(ms), and length scales.

    The ``*_m`` components vary with the model (its features, ``lengths`` apart), the ``*_d`` ones with the device.
    """

    constant: float = 1.0
    runtime: float = 0.5
    kind: float = 0.3
    core: float = 0.2
    made: float = 0.2
    device: float = 0.2
    line: float = 0.15
    pair: float = 0.15
    setting: float = 0.15
    all_m: float = 0.5
    kind_m: float = 0.4
    unit_d: float = 0.4
    kind_d: float = 0.2
    unit_m: float = 0.2
    made_m: float = 0.2
    pair_m: float = 0.2
    setting_m: float = 0.15
    model: float = 0.1
    known: float = 0.1
    noise: float = 0.06
    length_macs: float = 1.0
    length_activations: float = 1.0
    length_weights: float = 1.0
    length_layers: float = 1.0
    length_traits: float = 1.0
    length_device: float = 3.0
    length_kind: float = 1.0


BLOCK = 32
"""Rows of the covariance that are computed at a time: they stay in the processor's cache."""


def kernel(first: Rows, second: Rows, scales: Scales) -> Array:
    """Return the covariance of two sets of rows without noise, (n, m)."""
    lengths = np.array([scales.length_macs, scales.length_activations, scales.length_weights, scales.length_layers])
    models = [np.hstack([rows.model / lengths, rows.traits / scales.length_traits]) for rows in (first, second)]
    covariance = np.empty((len(first), len(second)))
    for begin in range(0, len(first), BLOCK):
        part = slice(begin, begin + BLOCK)
        keys = {name: values[part] for name, values in first.keys.items()}
        smooth, near = _similarities(_squares(models[0][part], models[1]))
        devices = _squares(first.device[part], second.device)
        covariance[part] = _covariance(keys, second.keys, smooth, near, devices, scales)
    return covariance


def _similarities(squares: Array) -> tuple[Array, Array]:
    """Return similarities of models, with a long tail and with a short one."""
    return 1 / (1 + squares / 2), np.exp(-squares / 2)


def _covariance(
    first: Mapping[str, Array], second: Mapping[str, Array], smooth: Array, near: Array, devices: Array, scales: Scales
) -> Array:
    def same(name: str) -> Array:
        return np.asarray(first[name][:, None] == second[name][None])

    covariance = scales.constant**2 + scales.all_m**2 * smooth
    covariance += same("runtime") * scales.runtime**2
    twins = np.exp(devices / (-2 * scales.length_kind**2))
    covariance += same("kind") * (scales.kind**2 + scales.kind_m**2 * smooth + scales.kind_d**2 * twins)
    alike = np.exp(devices / (-2 * scales.length_device**2))
    covariance += same("unit") * (scales.unit_d**2 * alike + scales.unit_m**2 * smooth)
    covariance += same("core") * scales.core**2
    covariance += same("made") * (scales.made**2 + scales.made_m**2 * smooth)
    covariance += same("device") * scales.device**2
    covariance += same("line") * scales.line**2
    covariance += same("pair") * (scales.pair**2 + scales.pair_m**2 * smooth)
    covariance += same("setting") * (scales.setting**2 + scales.setting_m**2 * near)
    covariance += same("model") * scales.model**2
    covariance += same("known") * scales.known**2
    return np.asarray(covariance)


def _squares(first: Array, second: Array) -> Array:
    """Return the squared distances of two sets of points, (n, m)."""
    sums = (first * first).sum(1)[:, None] + (second * second).sum(1)[None] - 2 * first @ second.T
    return np.asarray(np.maximum(sums, 0))


class Process:
    """The process conditioned on measurements.

    Args:
        logs: (n,) natural logarithm of the latency in ms.
        noise: (n,) standard deviation of each measurement; that of the fit when None.
    """

    def __init__(self, rows: Rows, logs: Array, scales: Scales, noise: Array | None = None) -> None:
        from scipy.linalg import cho_solve, cholesky  # every command line imports this module, few solve anything

        self.rows, self.logs, self.scales = rows, logs, scales
        self.noise = np.full(len(rows), scales.noise) if noise is None else noise
        covariance = kernel(rows, rows, scales)
        covariance[np.diag_indices(len(rows))] += self.noise**2
        self._factor = cholesky(covariance, lower=True, overwrite_a=True)
        self._weights = cho_solve((self._factor, True), logs - rows.prior)

    def predict(self, questions: Rows) -> tuple[Array, Array]:
        """Return mean and standard deviation of log(ms) of each question, including the noise of a measurement."""
        mean, covariance = self.joint(questions)
        return mean, np.sqrt(np.diag(covariance) + self.scales.noise**2)

    def joint(self, questions: Rows) -> tuple[Array, Array]:
        """Return mean (n,) and covariance (n, n) of log(ms) without noise."""
        from scipy.linalg import solve_triangular

        across = kernel(self.rows, questions, self.scales)
        mean = questions.prior + across.T @ self._weights
        half = solve_triangular(self._factor, across, lower=True)
        return mean, kernel(questions, questions, self.scales) - half.T @ half
