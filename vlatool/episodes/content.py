"""What decides how an episode ends, as a hash: when it is the same, the outcome is, too."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.episodes import play
from vlatool.episodes.play import EpisodesJob
from vlatool.files.messages import to_json
from vlatool.machine.host import cpu_model, isa
from vlatool.machine.instruction_sets import openvino_set
from vlatool.machine.version import VERSION
from vlatool.module.factory import factory_file, split_factory
from vlatool.module.imports import imported_files
from vlatool.runtime.engine import identities
from vlatool.user_code.walk import files_below

MOST_FILES = 20_000
"""Beside an environment; where there are more, only those that its code imports are looked at."""


def circumstances(bundle: Bundle, engine: str, job: EpisodesJob) -> dict[str, Any]:
    """Return what decides the outcomes of all jobs of a bundle in one environment, as JSON values."""
    built = identities().get(engine or bundle.manifest.engine)
    return {
        "bundle": bundle.hash,
        "engine": engine,
        "environment": environment_hash(job),
        "vlatool": VERSION,
        "steps": play.STEP_LIMIT,
        "instruction set": openvino_set(),
        **({"engine built against": built} if built else {}),
        "processor": [cpu_model(), isa()],
        "python": platform.python_version(),
        "packages": _installed(),
        "folder": os.getcwd(),
    }


def key_of(around: dict[str, Any], job: EpisodesJob) -> str:
    """Return the key of a job's outcomes: all that decides them, which a limit in time does not."""
    return json.dumps([around, to_json(replace(job, timeout_s=0.0))], sort_keys=True)


def environment_hash(job: EpisodesJob) -> str:
    """Return the hash of an environment: its code, and size and time of whatever lies beside or below that.

    What code reads cannot be told from it: a file that is written anew counts as another one, and so an environment
    that writes beside its own code is another one after each run.
    """
    file = factory_file(job.environment, Path(job.folder))
    file, folder = (file, file.parent) if file else _installed_at(job.environment)
    found = {file} if file else set()
    if folder:
        found |= imported_files(found, folder)
        below = list(islice(files_below(folder), MOST_FILES + 1))
        found |= set(below) if len(below) <= MOST_FILES else set()
    digest = hashlib.sha256(job.environment.encode())
    for path in sorted(found):
        digest.update(json.dumps([str(path), *_content(path)]).encode())
    return digest.hexdigest()


def _content(path: Path) -> Iterator[str]:
    try:
        about = path.stat()
        if path.suffix == ".py":
            yield hash_file(path)
        else:
            yield f"{about.st_size} {about.st_mtime_ns}"
    except OSError as error:  # playing says what is wrong
        yield str(error.strerror)


def _installed_at(factory: str) -> tuple[Path | None, Path | None]:
    """Return file and folder of ``package.module:make``, as far as they show without importing it."""
    try:
        spec = importlib.util.find_spec(split_factory(factory)[0].partition(".")[0])
    except (ImportError, ValueError):
        return None, None
    if spec is None or spec.origin is None:
        return None, None
    file = Path(spec.origin)
    return file, file.parent if spec.submodule_search_locations else None


def _installed() -> list[str]:
    """Return names and versions of all installed distributions, as their folders are called."""
    endings = (".dist-info", ".egg-info")
    found: set[str] = set()
    for entry in sys.path:
        try:
            found.update(name for name in os.listdir(entry or os.curdir) if name.endswith(endings))
        except OSError:
            continue
    return sorted(found)
