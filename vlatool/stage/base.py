"""A stage: a function from a directory to a directory, described by a small frozen object that round-trips as JSON.

The class of a stage is its options (the fields), its method (``run``), its command-line flags and its row in the
reference docs. No module, session or open file crosses the border of a stage.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import ConfigDict

from vlatool import registry
from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import PluginError, RecipeError
from vlatool.files.numbers import Numeric
from vlatool.files.resumable_work import Store
from vlatool.files.tree import hash_directory
from vlatool.machine.instruction_sets import openvino_set
from vlatool.machine.version import VERSION
from vlatool.report import Report
from vlatool.runtime.engine import identities

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

OnProgress = Callable[[str, float | None], None]
BEFORE_ENGINES = ("sources", "export")
"""Kinds of stages whose output is the same whatever an engine computes in."""
DEFINE_RUN = "define it; docs/guides/add-a-method.md shows a complete stage"
RECORD_VERSION = 2
"""Version of what a manifest holds, part of the cache key: an output of an older one is not taken for one of this."""


def _silent(_what: str, _share: float | None) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class Context:
    """What a stage may use while it runs, none of which changes its result.

    Args:
        progress: callback: what is being done, and the share that is done (0-1, None when unknown).
        workers: number of processes that a stage may start; 0 for as many as the launcher has room for.
        command: command line, for reports.
        measure_remotely: function that measures on another machine: job, bundles that it names, ``progress`` -> result;
            None to measure on this machine.
        events: folder for the TensorBoard events of a training; none when empty.
        video: file for the video of an episode of an evaluation; none when empty.
        force: whether a video that vlatool wrote there may be replaced.
        launcher: what starts the workers that play episodes: an entry of the kind ``workers``.
        unfinished: list that receives the folders of unfinished work (``files.resumable_work.Store``), to be removed
            once the result is written; None to store none.
        store: results stored during this run, once a stage has opened it.
        notes: list that receives sentences for the report on how it was computed.
        messages: list that receives sentences on what a stage did, which the command line prints.
    """

    progress: OnProgress = field(default=_silent)
    workers: int = 1
    command: str = ""
    measure_remotely: Callable[[Mapping[str, Any], Sequence[Path], OnProgress], dict[str, Any]] | None = None
    events: str = ""
    video: str = ""
    force: bool = False
    launcher: str = "processes"
    unfinished: list[Path] | None = None
    store: Store | None = None
    notes: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)

    def about(self, whose: str) -> Context:
        """Return the context with a prefix for its progress, unless that is empty."""
        return replace(self, progress=lambda what, share: self.progress(f"{whose}: {what}", share)) if whose else self


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


class Stage(Numeric):
    """Base of every stage: options as fields, extra keys refused, frozen."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    tried: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Options with which a search of ``optimize`` tries the stage: ending of the plan's name -> options."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Distributions whose versions change the result whatever the options; part of the cache key and the record."""
    imports: ClassVar[tuple[str, ...]] = ()
    """Modules that it imports when it runs; the server that forks children for it imports them once."""

    @classmethod
    def kind(cls) -> str:
        """Folder of the stage, for example ``quantize``."""
        return registry.entry_of(cls).partition(".")[0]

    @classmethod
    def name(cls) -> str:
        """Name in a recipe, for example ``quantize.static_int8``."""
        return registry.entry_of(cls)

    def options(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, as JSON values."""
        return self.model_dump(mode="json", exclude_defaults=True)

    def explicit_options(self) -> dict[str, Any]:
        """Return the options that were given, as JSON values: the same stage is built of them, which knows it too."""
        return self.model_dump(mode="json", exclude_unset=True)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """Raise a user error when this stage cannot run on that source; a cheap check."""

    def trust_code(self) -> Self:
        """Allow the code of policies that the options name to run: the user typed them (not for options in a file)."""
        return self

    def inputs(self) -> tuple[Path, ...]:
        """Files and directories outside the source whose content changes the result; part of the cache key."""
        return ()

    def used_packages(self) -> tuple[str, ...]:
        """Return the distributions whose versions change the result of a stage with these options."""
        return self.packages

    def key(self, source_hash: str) -> str:
        """Return the cache key of this stage's output: 16 hex digits.

        What OpenVINO answers and how fast it is depends on the instruction set that it computes in, what other engines
        answer depends on what they say themselves, and a bundle records how far its engine is from its graphs.
        """
        versions = {package: installed_version(package) for package in self.used_packages()}
        files = [content_hash(path) for path in self.inputs()]
        content = [self.name(), self.model_dump(mode="json"), source_hash, files, versions, VERSION, RECORD_VERSION]
        content += [] if self.kind() in BEFORE_ENGINES else [openvino_set(), *identities().items()]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


class Transform(Stage):
    """A stage that makes a bundle."""

    takes_modules: ClassVar[bool] = False
    """Whether it starts from a source bundle without graphs, since it works on the policy's torch modules."""
    trains: ClassVar[bool] = False
    """Whether it changes weights step by step, and tells of each (``Context.events``)."""
    runs_graphs: ClassVar[bool] = False
    """Whether it opens or runs new graphs: it does so in a child process, since an engine may crash."""
    streams: ClassVar[bool] = False
    """Whether it can take a source bundle that has no graphs yet and read the policy's shards itself."""

    def on(self, profile: Profile) -> Self:
        """Return the stage with the options that a board needs; options that were given stay."""
        return self

    def on_this_host(self) -> Self:
        """Return the stage with the options that this host needs, where no board is named; given ones stay."""
        return self

    def runs(self, source: Bundle | None) -> str:
        """Return whose code this stage runs on that source (``policy.py``); empty when only vlatool's own.

        Such a stage is run in a child process, as those that run graphs are; see ``vlatool.user_code.children``.
        """
        return ""

    def chain(self) -> tuple[Transform, ...]:
        """Return the stages that this one stands for: those that its options ask for first, then what is left of it.

        The command line and recipes run them one after the other, so that each is cached, recorded and rebuilt as if it
        had been named. A stage that stands for several refuses ``run``.

        Raises:
            RecipeError: when an option cannot be read.
        """
        return (self,)

    def following_stages(self) -> tuple[tuple[str, dict[str, Any]], ...]:
        """Return the stages that the command line runs after this one, each with its options; a recipe names them."""
        return ()

    def summary(self, bundle: Bundle) -> tuple[str, ...]:
        """Return a summary of the new bundle, which is printed even where other stages follow."""
        return ()

    def lines(self, bundle: Bundle) -> tuple[str, ...]:
        """Return further sentences on the new bundle, one for each line."""
        return ()

    def accept(self, bundle: Bundle) -> None:
        """Raise when the result does not meet the request; its output is then discarded."""

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Write the new bundle into the empty directory ``out`` and return it."""
        raise PluginError(f"The stage {self.name()} has no method run().", DEFINE_RUN)

    def _recorded_options(self) -> dict[str, Any]:
        """Return the options with files named by name and content: paths are not recorded."""
        options = self.options()
        for name in options:
            value = getattr(self, name)
            if isinstance(value, Path):
                whole = value in self.inputs() or not value.is_dir()  # of a policy only some files count
                digest = content_hash(value) if whole else f"absent:{value.name}"
                options[name] = f"{value.name} sha256:{digest[:16]}"
        return options

    def made_by(self, seed: int | None = None, calibration: SampleSet | None = None) -> dict[str, Any]:
        """Return the ``made_by`` entry of the manifest.

        Args:
            seed: seed of what the stage draws itself; ``finish`` notes the seed of noise and golden inputs otherwise.
            calibration: the samples that the stage calibrated on, after the last one was used.

        Returns:
            ``vlatool``, ``stage``, ``options`` that differ from their defaults, ``versions``, and where there are any
            ``files`` (name -> SHA-256 of each file outside the source), ``seed`` and ``calibration``. No paths, no
            times: the same command gives the same entry in another directory and on another day.
        """
        installed = {package: installed_version(package) for package in self.used_packages()}
        versions = {package: version for package, version in installed.items() if version}
        entry: dict[str, Any] = {"vlatool": VERSION, "stage": self.name(), "options": self._recorded_options()}
        files = self.input_hashes()
        entry |= {"versions": versions, **({"files": files} if files else {})}
        entry |= {} if seed is None else {"seed": seed}
        return entry | ({} if calibration is None else {"calibration": calibration.record()})

    def input_hashes(self) -> dict[str, str]:
        """Return name -> SHA-256 of the inputs outside the source; a second one of the same name is ``NAME (2)``."""
        hashes: dict[str, str] = {}
        for path in (path for path in self.inputs() if path.is_file() or path.is_dir()):
            digest, name, number = content_hash(path), path.name, 1
            while hashes.get(name, digest) != digest:
                number += 1
                name = f"{path.name} ({number})"
            hashes[name] = digest
        return hashes


class Measure(Stage):
    """A stage that makes a report."""

    remotely: ClassVar[bool] = False
    """Whether it can measure on another machine (``Context.measure_remotely``)."""
    runs_graphs: ClassVar[bool] = False
    """Whether it opens graphs itself, not in processes that it starts: then it runs in a child, as above."""
    films: ClassVar[bool] = False
    """Whether it can write a video of what it measured (``Context.video``)."""

    def on(self, profile: Profile) -> Measure:
        """Return the stage as it is for a board."""
        return self

    def run(self, source: Bundle, context: Context) -> Report:
        """Measure and return the report; the caller writes it."""
        raise PluginError(f"The stage {self.name()} has no method run().", DEFINE_RUN)


def source_of(source: Bundle | None, stage: str) -> Bundle:
    """Return the source, which only the stages that start a chain may lack.

    Raises:
        RecipeError: when there is none.
    """
    if source is None:
        raise RecipeError(
            f"{stage} needs a bundle to start from; begin the recipe with a sources stage.",
            "name a bundle, or the policy that it is made from",
        )
    return source


def installed_version(package: str) -> str | None:
    """Return the version of a distribution, None when it is not installed."""
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file as hex, or that of a directory with all files below it; ``absent:NAME`` of neither.

    Raises:
        DataError: for a directory that holds something else than files.
    """
    if path.is_file():
        return hash_file(path)
    return hash_directory(path) if path.is_dir() else f"absent:{path.name}"
