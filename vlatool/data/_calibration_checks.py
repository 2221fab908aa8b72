"""What about a calibration recording looks wrong although a policy can run on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data._recording import Recording
from vlatool.errors import suggest
from vlatool.runtime.statistics import load_normaliser

Array = NDArray[Any]
MIN_SAMPLES = 8
"""Samples below which the extremes of activations are hardly seen."""
MAX_DEVIATIONS = 50.0
"""Training deviations (or ranges) beyond which a value is not a measurement of the same quantity."""
MAX_CHANNELS = 6
"""Channels that a message lists."""


def calibration_checks(
    recording: Recording, numbers: Sequence[int], spec: PolicySpec, assets: Path, wanted: int = 0
) -> list[str]:
    """Return a sentence for each thing that makes ranges of activations unreliable.

    Args:
        numbers: The samples that are used.
        assets: Directory of its statistics.
        wanted: Samples that were asked for; 0 when nobody did.
    """
    sentences = [*_of_count(recording, len(numbers), wanted), *_of_names(recording, spec)]
    same = len(numbers) > 1 and _identical(recording, numbers)
    if same:
        sentences.append(
            f"all {len(numbers)} calibration samples of {recording.path} are identical; "
            "record different moments, or the ranges fit one of them alone"
        )
    for tensor in (each.observation for each in spec.inputs):
        where = f"'{tensor.name}' in {recording.path}"
        if tensor.dtype == "uint8":
            sentences += _of_pixels(where, recording, tensor.name, numbers)
            continue
        values = recording.inputs[tensor.name][list(numbers)]
        if tensor.kind == "text":
            sentences += _of_text(where, values, numbers)
        elif values.dtype.kind in "iuf" and np.dtype(tensor.dtype).kind == "f":
            sentences += [] if same else _of_channels(where, tensor, values)
            sentences += _of_distance(where, tensor, values, numbers, assets)
            if values.dtype == np.float64 and tensor.dtype != "float64":
                sentences.append(f"{where} is float64; the policy takes {tensor.dtype}, so it is rounded")
    return sentences


def _of_count(recording: Recording, count: int, requested: int) -> Iterator[str]:
    if count < requested:
        yield f"{requested} calibration samples were asked for; {recording.path} holds {count}"
    if count < MIN_SAMPLES:
        yield f"ranges from {count} calibration samples are unreliable; use 64 or more, from every task"


def _of_names(recording: Recording, spec: PolicySpec) -> Iterator[str]:
    known = [tensor.name for tensor in spec.inputs]
    for name in recording.ignored:
        yield (
            f"{recording.path} has the array '{name}', which is not an input of the policy and is ignored; "
            + suggest(name, known)
        )


def _identical(recording: Recording, numbers: Sequence[int]) -> bool:
    return all(
        np.array_equal(values[number], values[numbers[0]]) for values in recording.inputs.values() for number in numbers
    )


def _of_text(where: str, values: Array, numbers: Sequence[int]) -> Iterator[str]:
    empty = [number for number, text in zip(numbers, values.tolist(), strict=True) if not text.strip()]
    if empty:
        yield (
            f"the text {where} is empty in {len(empty)} of {len(numbers)} calibration samples; the first is sample "
            f"{empty[0]}"
        )


def _of_pixels(where: str, recording: Recording, name: str, numbers: Sequence[int]) -> Iterator[str]:
    values = recording.inputs[name]
    highest = max(int(values[number].max(initial=0)) for number in numbers)
    if values.ndim > 2 and highest <= 1:
        look = "looks normalised: no pixel is above 1" if highest else "is black in every calibration sample"
        yield f"{where} {look}; the policy takes raw pixel values from 0 to 255"


def _of_channels(where: str, tensor: TensorSpec, values: Array) -> Iterator[str]:
    """Find channels (entries of the last axis) that never change."""
    if len(values) < 2 or not values.size:
        return
    rows = values.reshape(-1, values.shape[-1]) if values.ndim > 1 else values.reshape(-1, 1)
    constant = np.flatnonzero(rows.min(0) == rows.max(0)).tolist()  # never where one is NaN
    if constant:
        named = ", ".join(
            f"{channel}{f' ({tensor.labels[channel]})' if tensor.labels else ''} = {float(rows[0, channel]):g}"
            for channel in constant[:MAX_CHANNELS]
        )
        more = f" and {len(constant) - MAX_CHANNELS} more" if len(constant) > MAX_CHANNELS else ""
        yield (
            f"{where} never changes over the {len(values)} calibration samples in channel {named}{more}; "
            "what depends on it is not calibrated"
        )


def _of_distance(where: str, tensor: TensorSpec, values: Array, numbers: Sequence[int], assets: Path) -> Iterator[str]:
    """Find values that are far from what the policy was trained on."""
    normaliser = load_normaliser(tensor, assets)
    if normaliser is None or not values.size:
        return
    distances = np.abs((values.astype(np.float64) - normaliser.offset) / normaliser.scale).reshape(
        len(values), -1, values.shape[-1]
    )
    distances[~np.isfinite(distances)] = 0
    if not (distances > MAX_DEVIATIONS).any():
        return
    far = np.flatnonzero((distances > MAX_DEVIATIONS).any(axis=(1, 2)))
    worst, _, channel = np.unravel_index(int(distances.argmax()), distances.shape)
    unit = "standard deviations from the training mean" if tensor.normalisation == "mean_std" else (
        "half ranges from the middle of the training range")  # fmt: skip
    yield (
        f"{where} is {float(distances.max()):.3g} {unit} in channel {int(channel)} of sample {numbers[int(worst)]} "
        f"(above {MAX_DEVIATIONS:g} in {len(far)} of {len(values)} calibration samples); look at units, "
        "statistics and names"
    )
