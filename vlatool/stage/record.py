"""What a manifest records of the stage that made its bundle: options, versions, files, and the samples it used."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from vlatool.machine.version import VERSION
from vlatool.stage.base import Stage, content_hash, installed_version


class SampleSet:
    """A fingerprint of the samples that a stage calibrates on, taken while they stream by.

    Example:
        >>> samples = SampleSet()
        >>> for observation in samples.watch([{"proprio": [0.5, 1.0]}]): pass
        >>> samples.record()["samples"]
        1
    """

    def __init__(self) -> None:
        self._hashes: list[str] = []

    def watch(self, observations: Iterable[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
        """Yield the observations, each hashed before it is handed on; go through one ``SampleSet`` once."""
        for observation in observations:
            self._hashes.append(_sample_hash(observation))
            yield observation

    def record(self) -> dict[str, Any]:
        """Return ``samples``, how many there were, and ``sha256``, the hash of their hashes in order."""
        return {"samples": len(self._hashes), "sha256": hashlib.sha256("\n".join(self._hashes).encode()).hexdigest()}


def _sample_hash(observation: Mapping[str, Any]) -> str:
    """Hash names, types, shapes and values of one observation."""
    import numpy as np

    digest = hashlib.sha256()
    for name in sorted(observation):
        value = np.ascontiguousarray(observation[name])
        text = value.dtype.kind in "US"
        content = json.dumps(value.tolist()).encode() if text else value.tobytes()
        kind = "text" if text else value.dtype.str
        digest.update(json.dumps([name, kind, list(np.shape(observation[name])), len(content)]).encode() + content)
    return digest.hexdigest()


def made_by(stage: Stage, seed: int | None = None, calibration: SampleSet | None = None) -> dict[str, Any]:
    """Return the ``made_by`` entry of the manifest.

    Args:
        stage: stage that makes the bundle.
        seed: seed of what the stage draws itself; ``finish`` notes the seed of noise and golden inputs otherwise.
        calibration: the samples that the stage calibrated on, after the last one was used.

    Returns:
        ``vlatool``, ``stage``, ``options`` that differ from their defaults, ``versions``, and where there are any
        ``files`` (name -> SHA-256 of each file outside the source), ``seed`` and ``calibration``. No paths, no
        times: the same command gives the same entry in another directory and on another day.
    """
    installed = {package: installed_version(package) for package in stage.used_packages()}
    versions = {package: version for package, version in installed.items() if version}
    entry: dict[str, Any] = {"vlatool": VERSION, "stage": stage.name(), "options": _recorded_options(stage)}
    files = input_hashes(stage)
    entry |= {"versions": versions, **({"files": files} if files else {})}
    entry |= {} if seed is None else {"seed": seed}
    return entry | ({} if calibration is None else {"calibration": calibration.record()})


def input_hashes(stage: Stage) -> dict[str, str]:
    """Return name -> SHA-256 of the inputs outside the source; a second one of the same name is ``NAME (2)``."""
    hashes: dict[str, str] = {}
    for path in (path for path in stage.inputs() if path.is_file() or path.is_dir()):
        digest, name, number = content_hash(path), path.name, 1
        while hashes.get(name, digest) != digest:
            number += 1
            name = f"{path.name} ({number})"
        hashes[name] = digest
    return hashes


def _recorded_options(stage: Stage) -> dict[str, Any]:
    """Return the options with files named by name and content: paths are not recorded."""
    options = stage.options()
    for name in options:
        value = getattr(stage, name)
        if isinstance(value, Path):
            whole = value in stage.inputs() or not value.is_dir()  # of a policy only some files count
            digest = content_hash(value) if whole else f"absent:{value.name}"
            options[name] = f"{value.name} sha256:{digest[:16]}"
    return options
