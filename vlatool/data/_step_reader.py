"""Readers of datasets of one step a row, and the recording for a policy that is made of such a dataset."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data._reader import Reader
from vlatool.data._recording import Recording, Values, build_recording
from vlatool.data._steps import Steps
from vlatool.data._windows import with_windows
from vlatool.errors import DataError, suggest
from vlatool.files.rows import in_memory

SEPARATORS = re.compile(r"[./]")


class StepReader(Reader):
    """Reads datasets of one step a row; bundles carry a sample of them."""

    carries_sample: ClassVar[bool] = True

    def steps(self, path: Path) -> Steps:
        """Return what a dataset holds; pictures are decoded when they are read.

        Raises:
            DataError: when it is corrupt.
            MissingExtra: when the library of the format is not installed.
        """
        raise NotImplementedError

    def open(self, path: Path, spec: PolicySpec, names: Mapping[str, str]) -> Recording:
        """Open a recording; see ``recording_of``.

        Raises:
            DataError: when it is corrupt, or does not fit the spec.
            MissingExtra: when the library of the format is not installed.
        """
        return recording_of(self.steps(path), spec, names)


def recording_of(steps: Steps, spec: PolicySpec, names: Mapping[str, str]) -> Recording:
    """Return the recording for a policy: its inputs by name, and the actions that follow each step.

    An input is the column that ``names`` says, else that of its name, else the only one whose name ends with it
    (``observation.state`` for ``state``); an instruction is the only text.

    Raises:
        DataError: when an input is not there, or does not fit the spec.
    """
    known = {*(tensor.name for tensor in spec.inputs), spec.action.name, "action"}
    if unknown := sorted({*names} - known):
        raise DataError.unknown(f"A name is mapped that the policy does not have: '{unknown[0]}'", unknown[0], known)
    arrays: dict[str, Values] = {tensor.name: _input(steps, tensor, names) for tensor in spec.inputs}
    action = names.get(spec.action.name) or names.get("action") or steps.action
    if action:
        arrays["action"] = in_memory(steps.column(action))
    arrays["episode"] = steps.episodes
    return with_windows(build_recording(steps.path, arrays, spec, {}, steps.times))


def _input(steps: Steps, tensor: TensorSpec, names: Mapping[str, str]) -> Values:
    if tensor.name in names or tensor.name in steps.columns:
        return steps.column(names.get(tensor.name, tensor.name))
    texts = [name for name, values in steps.columns.items() if values.dtype.kind == "U"]
    alike = [name for name in steps.columns if _last(name) == _last(tensor.name)]
    found = texts if tensor.kind == "text" and len(texts) == 1 else alike
    if len(found) != 1:
        problem = f"has several for '{tensor.name}'" if found else f"has no '{tensor.name}'"
        raise DataError(
            f"{steps.path} {problem}; {suggest(tensor.name, found or steps.columns)}.",
            f"say which one it is: --map {tensor.name}=NAME, or map: {{{tensor.name}: NAME}} in policy.yaml",
        )
    return steps.columns[found[0]]


def _last(name: str) -> str:
    """Return the last part of a name.

    Example:
        >>> _last("observation.images.top"), _last("obs/agentview_image")
        ('top', 'agentview_image')
    """
    return SEPARATORS.split(name)[-1]
