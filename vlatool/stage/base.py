"""A stage: a function from a directory to a directory, described by a small frozen object that round-trips as JSON.

The class of a stage is its options (the fields), its method (``run``), its command-line flags and its row in the
reference docs. No module, session or open file crosses the border of a stage.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import ConfigDict

from vlatool import registry
from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import PluginError, RecipeError
from vlatool.files.numbers import Numeric
from vlatool.files.tree import hash_directory
from vlatool.machine.instruction_sets import openvino_set
from vlatool.machine.version import VERSION
from vlatool.report import Report
from vlatool.runtime.engine import identities

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile

OnProgress = Callable[[str, float | None], None]
OnNote = Callable[[str], None]
BEFORE_ENGINES = ("sources", "export")
"""Kinds of stages whose output is the same whatever an engine computes in."""
DEFINE_RUN = "define it; docs/guides/add-a-method.md shows a complete stage"
RECORD_VERSION = 2
"""Version of what a manifest holds, part of the cache key: an output of an older one is not taken for one of this."""


def _no_progress(_what: str, _share: float | None) -> None:
    """Ignore progress."""


def _no_note(_sentence: str) -> None:
    """Ignore a note."""


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
        work: folder for finished parts of a measurement (``files.resumable_work.Store``), which whoever writes the
            report removes afterwards; none are stored when empty.
        note: callback: sentence on how something was measured, for reports on it.
    """

    progress: OnProgress = _no_progress
    workers: int = 1
    command: str = ""
    measure_remotely: Callable[[Mapping[str, Any], Sequence[Path], OnProgress], dict[str, Any]] | None = None
    events: str = ""
    video: str = ""
    force: bool = False
    launcher: str = "processes"
    work: str = ""
    note: OnNote = _no_note

    def about(self, whose: str) -> Context:
        """Return the context with a prefix for its progress, unless that is empty."""
        return replace(self, progress=lambda what, share: self.progress(f"{whose}: {what}", share)) if whose else self


@dataclass(frozen=True)
class Result:
    """What a stage that makes a bundle gives.

    Args:
        bundle: new bundle.
        messages: sentences on what the stage did, which the command line prints.
    """

    bundle: Bundle
    messages: tuple[str, ...] = ()


@dataclass(frozen=True)
class Chain:
    """The other stages that a stage stands for; the command line runs them as if each had been named.

    Args:
        before: stages that its options ask for first, in order: name -> options.
        after: stages that are to follow it, which a recipe names itself.
        options: options that ask for the stages before it; what is left of the stage has their defaults.
    """

    before: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    after: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    options: tuple[str, ...] = ()


class Stage(Numeric):
    """Base of every stage: options as fields, extra keys refused, frozen."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    tried: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Options with which a search of ``optimize`` tries the stage: ending of the plan's name -> options."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Distributions whose versions change the result whatever the options; part of the cache key and the record."""
    policies: ClassVar[tuple[str, ...]] = ()
    """Options that name policies, whose code may run once a user typed them (not for options in a file)."""
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

    def on(self, board: Profile | None) -> Self:
        """Return the stage with the options that a board needs, or this host where that is None; given ones stay."""
        return self

    def unless_given(self, options: Mapping[str, Any]) -> Self:
        """Return the stage with options, but for those that were given."""
        return self.model_copy(update={name: options[name] for name in options.keys() - self.model_fields_set})

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
    runs_graphs: ClassVar[bool] = True
    """Whether it opens or runs graphs or modules: it does so in a child process, since these may end the process."""
    streams: ClassVar[bool] = False
    """Whether it can take a source bundle that has no graphs yet and read the policy's shards itself."""

    def chain(self) -> Chain:
        """Return the stages before and after this one, if any; raises RecipeError when an option cannot be read."""
        return Chain()

    def summarize(self, bundle: Bundle) -> tuple[str, ...]:
        """Return sentences on a bundle that this stage made, now or earlier."""
        return ()

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Write a new bundle of a source that ``check`` accepts into the empty directory ``out``.

        Raises:
            VlatoolError: when the result does not meet the request, too; ``out`` is then discarded.
        """
        raise PluginError(f"The stage {self.name()} has no method run().", DEFINE_RUN)


class Measure(Stage):
    """A stage that makes a report."""

    remotely: ClassVar[bool] = False
    """Whether it can measure on another machine (``Context.measure_remotely``)."""
    runs_graphs: ClassVar[bool] = False
    """Whether it opens graphs itself, not in processes that it starts: then it runs in a child, as above."""
    films: ClassVar[bool] = False
    """Whether it can write a video of what it measured (``Context.video``)."""

    def run(self, source: Bundle, context: Context) -> Report:
        """Measure and return the report; the caller writes it."""
        raise PluginError(f"The stage {self.name()} has no method run().", DEFINE_RUN)


def source_of(source: Bundle | None, stage: str) -> Bundle:
    """Return the source, which only the stages that start a chain may lack; raises RecipeError when there is none."""
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
