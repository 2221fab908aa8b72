"""A Gaussian process over the logarithm of latency: what is published near a question decides, and how far it is.

    log(ms) = log(roofline) + f,   f ~ GP(0, K)

K is a sum of components: some are shared by all that has one runtime, one device, one precision or one model; some
vary smoothly with what a model and a device are (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006,
chapters 2 and 5). A measurement on a board is one more point: conditioning on it is the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

KEYS = ("unit", "device", "runtime", "kind", "pair", "setting", "model", "known")
"""Categories of a row: class of unit; device and unit; runtime; runtime and precision; device, unit, runtime and
precision; all that and power mode, threads, version; model; model, runtime and precision."""


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
    def joined(first: Rows, second: Rows) -> Rows:
        """Return the rows of both."""
        keys = {name: np.concatenate([first.keys[name], second.keys[name]]) for name in KEYS}
        rest = (np.concatenate([getattr(first, name), getattr(second, name)]) for name in PARTS)
        return Rows(keys, *rest)


PARTS = tuple(field.name for field in fields(Rows))[1:]


@dataclass(frozen=True)
class Scales:
    """What the fit chooses: standard deviations of the components in log(ms), and lengths.

    The ``*_m`` components vary with the model (its features, ``lengths`` apart), ``unit_d`` with the device.
    """

    constant: float = 1.0
    runtime: float = 0.5
    kind: float = 0.3
    device: float = 0.2
    pair: float = 0.15
    setting: float = 0.15
    all_m: float = 0.5
    kind_m: float = 0.4
    unit_d: float = 0.4
    unit_m: float = 0.2
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
    length_device: float = 1.0


def kernel(first: Rows, second: Rows, scales: Scales) -> Array:
    """Return the covariance of two sets of rows without noise, (n, m)."""

    def same(name: str) -> Array:
        return np.asarray(first.keys[name][:, None] == second.keys[name][None])

    lengths = np.array([scales.length_macs, scales.length_activations, scales.length_weights, scales.length_layers])
    distance = _squares(first.model / lengths, second.model / lengths)
    distance += _squares(first.traits / scales.length_traits, second.traits / scales.length_traits)
    smooth = 1 / (1 + distance / 2)
    near = np.exp(-distance / 2)
    alike = np.exp(-_squares(first.device, second.device) / (2 * scales.length_device**2))
    found = scales.constant**2 + scales.all_m**2 * smooth
    found += same("runtime") * scales.runtime**2
    found += same("kind") * (scales.kind**2 + scales.kind_m**2 * smooth)
    found += same("unit") * (scales.unit_d**2 * alike + scales.unit_m**2 * smooth)
    found += same("device") * scales.device**2
    found += same("pair") * (scales.pair**2 + scales.pair_m**2 * smooth)
    found += same("setting") * (scales.setting**2 + scales.setting_m**2 * near)
    found += same("model") * scales.model**2
    found += same("known") * scales.known**2
    return np.asarray(found)


def _squares(first: Array, second: Array) -> Array:
    """Return the squared distances of two sets of points, (n, m)."""
    sums = (first * first).sum(1)[:, None] + (second * second).sum(1)[None] - 2 * first @ second.T
    return np.asarray(np.maximum(sums, 0))


class Process:
    """The process given measurements.

    Args:
        rows: What was measured.
        logs: (n,) natural logarithm of the latency in ms.
        scales: Of the fit.
        noise: (n,) standard deviation of each measurement; that of the fit when None.
    """

    def __init__(self, rows: Rows, logs: Array, scales: Scales, noise: Array | None = None) -> None:
        self.rows, self.logs, self.scales = rows, logs, scales
        self.noise = np.full(len(rows), scales.noise) if noise is None else noise
        covariance = kernel(rows, rows, scales)
        covariance[np.diag_indices(len(rows))] += self.noise**2
        self._whiten = lower_inverse(np.linalg.cholesky(covariance))
        self._weights = self._whiten.T @ (self._whiten @ (logs - rows.prior))

    def predict(self, questions: Rows) -> tuple[Array, Array]:
        """Return mean and standard deviation of log(ms) of each question; the noise of a measurement is in it."""
        mean, covariance = self.joint(questions)
        return mean, np.sqrt(np.diag(covariance) + self.scales.noise**2)

    def joint(self, questions: Rows) -> tuple[Array, Array]:
        """Return mean (n,) and covariance (n, n) of log(ms) without noise."""
        across = kernel(self.rows, questions, self.scales)
        mean = questions.prior + across.T @ self._weights
        half = self._whiten @ across
        return mean, kernel(questions, questions, self.scales) - half.T @ half


def lower_inverse(factor: Array) -> Array:
    """Return the inverse of a lower triangular matrix, by halves: nearly all of it is matrix products."""
    count = len(factor)
    if count <= 64:
        return np.linalg.inv(factor)
    half = count // 2
    found = np.zeros_like(factor)
    found[:half, :half] = lower_inverse(factor[:half, :half])
    found[half:, half:] = lower_inverse(factor[half:, half:])
    found[half:, :half] = -found[half:, half:] @ (factor[half:, :half] @ found[:half, :half])
    return found
