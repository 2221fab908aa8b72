"""A sample policy as every contestant needs it: its float32 graph and the same encoded observations for all."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[3]
WORKLOADS = ("resnet18", "vit-s", "vla-45m", "action-expert", "vit-b", "prefill-315m")
PARTS = ("calibration", "evaluation")
SEED = 0

Array = NDArray[Any]
Feeds = dict[str, Array]


class PeersError(Exception):
    """What the user is told instead of a traceback."""


@dataclass(frozen=True)
class Workload:
    """Where the files of one sample policy are.

    Args:
        name: Name of the sample.
        folder: Its folder below the work directory.
    """

    name: str
    folder: Path

    @property
    def policy(self) -> Path:
        return self.folder / "policy"

    @property
    def bundle(self) -> Path:
        """The float32 bundle."""
        return self.folder / "float32"

    @property
    def model(self) -> Path:
        """The float32 graph."""
        return self.bundle / "graphs" / "main.onnx"

    @property
    def feeds_file(self) -> Path:
        return self.folder / "feeds.npz"

    def feeds(self, part: str) -> list[Feeds]:
        """Return the encoded observations of a part, graph input -> array with the batch axis."""
        with np.load(self.feeds_file) as stored:
            arrays = {key.partition(".")[2]: stored[key] for key in stored.files if key.startswith(f"{part}.")}
        count = len(next(iter(arrays.values())))
        return [{name: array[index] for name, array in arrays.items()} for index in range(count)]

    def prepare(self) -> None:
        """Make, export and encode the sample, each once."""
        if not self.policy.is_dir():
            run_vlatool("samples", "make", self.name, "--seed", str(SEED), "-o", str(self.policy))
        if not self.bundle.is_dir():
            run_vlatool("export", "onnx", str(self.policy), "-o", str(self.bundle))
        if not self.feeds_file.is_file():
            with fresh(self.feeds_file) as draft:
                self._encode(draft)

    def _encode(self, file: Path) -> None:
        from vlatool.bundle.bundle import Bundle
        from vlatool.data import read_recording
        from vlatool.runtime.observation import ObservationEncoder

        bundle = Bundle.open(self.bundle)
        encode = ObservationEncoder(bundle.manifest.spec, bundle.path / "assets")
        feeds = bundle.manifest.program[0].feeds
        found: dict[str, Array] = {}
        for part in PARTS:
            recording = read_recording(bundle.path / "data" / f"{part}.npz", bundle.manifest.spec)
            rows = [encode(observation) for observation in recording]
            found.update({f"{part}.{key}": np.stack([row[value] for row in rows]) for key, value in feeds.items()})
        with file.open("wb") as stream:
            np.savez(stream, **found)


@contextmanager
def fresh(target: Path) -> Iterator[Path]:
    """Give a name to write to, which becomes ``target`` (a file or a directory) only when all went well."""
    draft = target.with_name(f".{target.name}.{os.getpid()}")
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield draft
        remove(target)
        draft.rename(target)
    finally:
        remove(draft)


def remove(path: Path) -> None:
    """Remove a file or a directory, if there is one."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def environment() -> dict[str, str]:
    """Return the environment of child processes: they find vlatool where this one does."""
    paths = [part for part in (os.environ.get("PYTHONPATH"), str(ROOT)) if part]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "PYTHONUNBUFFERED": "1"}


def run_vlatool(*arguments: str) -> None:
    """Run a ``vlatool`` command in a process of its own.

    Raises:
        PeersError: with its last words when it fails.
    """
    run_child([sys.executable, "-m", "vlatool", *arguments], "vlatool " + " ".join(arguments[:3]))


def run_child(command: list[str], what: str, timeout: float = 3600) -> None:
    """Run a command; say what failed in one line.

    Raises:
        PeersError: when it fails or does not end in time.
    """
    try:
        done = subprocess.run(
            command, env=environment(), timeout=timeout, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
    except subprocess.TimeoutExpired:
        raise PeersError(f"{what}: not done after {timeout:.0f} s") from None
    if done.returncode:
        raise PeersError(f"{what}: exit {done.returncode}: {last_words(done.stdout)}")


def last_words(text: str, lines: int = 2) -> str:
    """Return the end of a program's output in one line."""
    told = [line.strip() for line in text.splitlines() if line.strip()]
    return " / ".join(told[-lines:])[-400:] or "(it said nothing)"


Infer = Callable[[Feeds], Array]
