"""Samples of a recording that are written to a file of their own: ``vlatool data sample``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.data._reader import NamedRecording, read_recording, reader_of
from vlatool.data._recording import Values
from vlatool.data._sampling import sampled_rows, save_arrays, save_recording, task_numbers
from vlatool.files.rows import Rows


def sample_recording(named: NamedRecording, count: int, spec: PolicySpec, out: Path) -> int:
    """Write ``count`` samples for a policy, spread over the recording; return their number.

    Raises:
        DataError: when the recording is corrupt, or does not fit the spec.
    """
    recording = read_recording(named, spec)
    episodes = np.zeros(len(recording), np.int64) if recording.episodes is None else recording.episodes
    chosen = np.zeros(len(recording), np.bool_)
    chosen[sampled_rows(episodes, count, task_numbers(recording))] = True
    save_recording(recording.subset(chosen), out)
    return int(chosen.sum())


def sample_columns(named: NamedRecording, count: int, out: Path) -> int:
    """Write ``count`` rows of every column, spread over the recording; return their number.

    Raises:
        DataError: when the recording is corrupt, or has no column of a name that is mapped.
    """
    steps = reader_of(named.path).steps(named.path)
    rows = sampled_rows(steps.episodes, count, steps.tasks)
    chosen = np.zeros(len(steps), np.bool_)
    chosen[rows] = True
    columns: dict[str, Values] = {name: steps.column(recorded) for name, recorded in named.names.items()}
    used = {*columns, *named.names.values()}
    columns |= {name: values for name, values in steps.columns.items() if name not in used}
    if steps.action and "action" not in columns and steps.action in columns:
        columns["action"] = columns.pop(steps.action)
    columns["episode"] = steps.episodes
    save_arrays({name: _chosen(values, chosen) for name, values in columns.items()}, out)
    return len(rows)


def _chosen(values: Values, chosen: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Values:
    return values.select(chosen) if isinstance(values, Rows) else values[chosen]
