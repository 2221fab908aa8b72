"""Make a bundle again from its build record, without the cache, and compare it byte by byte with the first one."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

from vlatool.bundle.bundle import DIGEST, LOCATION, MANIFEST, UNRECORDED_NAMES, Bundle, hash_file
from vlatool.errors import BundleError, SourceError, VlatoolError
from vlatool.files.directory_writer import write_directory
from vlatool.files.ownership import LEDGER
from vlatool.files.scratch import scratch_directory
from vlatool.machine.version import VERSION
from vlatool.module.description import read_location
from vlatool.module.source import RECORDING_OPTIONS
from vlatool.optimize.result import ROBOT_FOLDERS
from vlatool.rebuild.differences import FileMatch, compare_bundles
from vlatool.runtime.engine import identities
from vlatool.sources import is_bundle, source_stage
from vlatool.stage.base import Context, Transform, content_hash, installed_version, source_of
from vlatool.stage.build import build_stage, stage_class
from vlatool.stage.finish import FINALIZED_FIELDS, OPTIMIZE, history, reseal
from vlatool.stage.record import input_hashes
from vlatool.stage.run import run_transform
from vlatool.user_code import trust

LAST_FILES = ("graphs", "golden", MANIFEST)
UNUSABLE = "make the bundle again, with the command that made it"

Entry = dict[str, Any]
RECORDED_FILE = re.compile(r"(?P<name>.+) sha256:(?P<hash>[0-9a-f]{16})")
"""How a record names a file that an option gives."""
GRAPHS = "graphs/"


@dataclass(frozen=True)
class RebuildResult:
    """What came of making a bundle again.

    Args:
        hash: ``sha256:...`` of the bundle that was made again.
        source: what it was made from.
        files: every hashed file and the manifest, compared byte by byte.
        stages: each stage that ran, in order, and whether its graphs are the recorded ones.
        left_out: fields of the manifest that were not compared, because they were measured.
    """

    bundle: Bundle
    hash: str
    source: str
    files: tuple[FileMatch, ...]
    stages: tuple[tuple[str, bool], ...]
    left_out: tuple[str, ...] = ()

    @property
    def identical(self) -> bool:
        """Whether every compared byte is the same."""
        return all(file.identical for file in self.files)

    @property
    def first_difference(self) -> FileMatch | None:
        """The file that differs and that others which differ were made from, None when none does."""
        differing = [file for file in self.files if not file.identical]
        return min(differing, key=lambda file: _rank(file.file), default=None)

    @property
    def differs_since(self) -> str:
        """The first stage that gave other graphs than the record names; empty when none did."""
        return next((name for name, same in self.stages if not same), "")

    @property
    def machine_may_differ(self) -> bool:
        """Whether all that differs is of the machine that made the bundle: golden outputs, and the manifest."""
        return all(each.identical or each.file == MANIFEST or each.file.startswith("golden/") for each in self.files)

    @property
    def files_beside(self) -> tuple[str, ...]:
        """What is in the bundle, and in no hash, so that nothing of it was compared."""
        hashed = (MANIFEST, DIGEST, LEDGER)
        return tuple(name for name in UNRECORDED_NAMES if name not in hashed and (self.bundle.path / name).exists())


def _rank(name: str) -> int:
    """Return how late in the making of a bundle a file comes: what differs first may be why later ones do."""
    folder = name.partition("/")[0]
    return LAST_FILES.index(folder) + 1 if folder in LAST_FILES else 0


@dataclass(frozen=True)
class _Start:
    """Where the stages begin: what a person would type, the bundle to start from (or None), the stages to run."""

    source: str
    bundle: Bundle | None
    stages: tuple[tuple[Entry, Transform | None], ...]
    """An entry without a stage is the one in which ``optimize`` finalizes a candidate."""


@dataclass
class _FileSearch:
    """Where files that an option names are looked for."""

    files: tuple[Path, ...]
    folders: list[Path] = field(default_factory=list)

    def find(self, name: str, digest: str, stage: str) -> Path:
        """Return the file of that name, which the record holds too, whose SHA-256 begins with ``digest``."""
        others = []
        for path in (*self.files, *(folder / name for folder in self.folders)):
            if path.exists():
                got = content_hash(path)
                if path.name == name and got.startswith(digest):
                    return path
                others.append(f"{path} has sha256:{got[:16]}")
        got_instead = f" ({'; '.join(others)})" if others else ""
        raise SourceError(
            f"{stage} was given the file {name} with sha256:{digest}, which is not here{got_instead}.",
            f"pass --file PATH/{name}, the file of that name and hash",
        )


def build_record(bundle: Bundle) -> tuple[Entry, ...]:
    """Return the checked build record; raises BundleError when there is none (older vlatool), or it is invalid."""
    entries = history(bundle)
    if not entries:
        version = bundle.manifest.made_by.get("vlatool", "an unknown version")
        raise BundleError(
            f"{bundle.path} has no build record; vlatool {version} did not write one yet, or no stage made it.",
            UNUSABLE,
        )
    for number, entry in enumerate(entries):
        where, stage = f"Entry {number} of the build record of {bundle.path}", entry.get("stage")
        mappings = all(isinstance(entry.get(name, {}), Mapping) for name in ("options", "versions", "files", "graphs"))
        if not (isinstance(stage, str) and mappings and isinstance(entry.get("input", ""), str)):
            raise BundleError(f"{where} is invalid: {json.dumps(entry)[:200]}.", UNUSABLE)
        if number and stage.startswith("sources."):
            raise BundleError(f"{where} is a source; only the first may be.", UNUSABLE)
    return entries


def version_changes(entries: Iterable[Entry]) -> dict[str, tuple[str, str]]:
    """Return package -> (recorded, installed) of each package whose version is not the recorded one.

    A package that stages recorded in several versions is named with the first that is not installed.
    """
    changed: dict[str, tuple[str, str]] = {}
    built = identities()
    for entry in entries:
        installed = {name: installed_version(name) or "not installed" for name in entry.get("versions", {})}
        recorded = {"vlatool": entry.get("vlatool", VERSION), **entry.get("versions", {})}
        for name, version in recorded.items():
            now = {"vlatool": VERSION, **installed, **built}[name]
            if version != now:
                changed.setdefault(name, (str(version), now))
    return changed


def rebuild(
    bundle: Bundle,
    context: Context,
    *,
    source: str | None = None,
    files: tuple[Path, ...] = (),
    cache: Path,
    out: Path | None = None,
    force: bool = False,
) -> RebuildResult:
    """Run the recorded stages again in a fresh directory and compare what they make with the bundle.

    Args:
        bundle: the bundle to make again; verified.
        source: policy directory, ``path.py:make``, ONNX file, or a bundle that is the input of a recorded stage; where
            the policy was when the bundle was made, if not given.
        files: files that options name and that are not beside the source.
        cache: where to look for the place of the source; no output of a stage is taken from it.
        out: where to write the bundle that was made again.
        force: whether to replace ``out``.

    Raises:
        SourceError: when the source is not found, or a file of it is not the recorded one.
        BundleError: when the bundle has no usable build record.
        VlatoolError: what a stage raises.
    """
    entries = build_record(bundle)
    start = _start(bundle, entries, source, files, cache)
    same: list[tuple[str, bool]] = []
    with scratch_directory() as scratch:
        product = start.bundle
        for number, (entry, stage) in enumerate(start.stages):
            before, folder = product, scratch / f"{number}-{entry['stage']}"
            product = (
                run_transform(stage, before, folder, context).bundle if stage else _finalize(entry, before, folder)
            )
            same.append((entry["stage"], _graphs_as_recorded(entry, product)))
            if before is not None and before is not start.bundle:
                shutil.rmtree(before.path)
        product = source_of(product, "rebuild")
        left_out = ("accuracy",) if "candidate" in bundle.manifest.made_by else ()
        compared = compare_bundles(bundle, product, left_out)
        if out is not None:
            with write_directory(out, force=force) as draft:
                shutil.copytree(
                    product.path, draft, dirs_exist_ok=True, ignore=shutil.ignore_patterns(LOCATION, LEDGER)
                )
        return RebuildResult(bundle, product.hash, start.source, compared, tuple(same), left_out)


def _start(
    bundle: Bundle, entries: tuple[Entry, ...], source: str | None, files: tuple[Path, ...], cache: Path
) -> _Start:
    """Find the source, check that it is the recorded one, and build every stage before any runs."""
    search = _FileSearch(files, [bundle.path.parent, Path()])
    if source is not None and is_bundle(source):
        begin, first = Bundle.open(source), None
        later = _from_bundle(begin, entries, bundle)
    elif not entries[0]["stage"].startswith("sources."):
        raise BundleError(
            f"The build record of {bundle.path} begins with {entries[0]['stage']}, whose input "
            f"({entries[0].get('input', '')[:19]}) was made by a vlatool that kept no record.",
            "pass --source BUNDLE, the bundle of that hash, or make the bundle again from the policy",
        )
    else:
        begin = None
        first, source = _recorded_source(bundle, entries, source, cache, search)
        later = entries[1:]
        policy = getattr(first, "model", None) or getattr(first, "policy", None)
        if policy is not None:
            search.folders.insert(0, policy if policy.is_dir() else policy.parent)
    stages = [(entry, None if entry["stage"] == OPTIMIZE else _stage(entry, search)) for entry in later]
    beginning = [] if first is None else [(entries[0], first)]
    return _Start(str(source), begin, (*beginning, *stages))


def _from_bundle(begin: Bundle, entries: tuple[Entry, ...], bundle: Bundle) -> tuple[Entry, ...]:
    """Return the stages that are left when a person hands in the output of an earlier one."""
    for number, entry in enumerate(entries):
        if entry.get("input") == begin.hash:
            return entries[number:]
    inputs = ", ".join(f"{entry['stage']} from {entry['input'][:19]}" for entry in entries if entry.get("input"))
    raise BundleError(
        f"{begin.path} is {begin.hash[:19]}, from which no stage of {bundle.path} started; recorded: {inputs}.",
        "pass the bundle of one of these hashes, or the policy",
    )


def _stage(entry: Entry, search: _FileSearch) -> Transform:
    """Build the stage of an entry, its files found and checked."""
    name = entry["stage"]
    stage = build_stage(name, _with_files(name, entry.get("options", {}), search))
    if not isinstance(stage, Transform):
        raise BundleError(
            f"The build record names {name}, which measures; it may only name stages that make bundles.", UNUSABLE
        )
    return stage


def _with_files(stage: str, recorded: Mapping[str, Any], search: _FileSearch) -> dict[str, Any]:
    """Return recorded options of a stage, with the paths of the files that they name."""
    fields, options = stage_class(stage).model_fields, dict(recorded)
    for key, value in options.items():
        if key in fields and Path in (fields[key].annotation, *get_args(fields[key].annotation)) and value is not None:
            match = RECORDED_FILE.fullmatch(str(value))
            if match is None:
                raise BundleError(f"The build record names the file '{value}' of {stage} without its hash.", UNUSABLE)
            options[key] = search.find(match["name"], match["hash"], stage)
    return options


def _recorded_source(
    bundle: Bundle, entries: tuple[Entry, ...], source: str | None, cache: Path, search: _FileSearch
) -> tuple[Transform, str]:
    """Return the source stage and where its policy is; its files have the recorded hashes."""
    problem: VlatoolError | None = None
    for folder in [source] if source is not None else _noted_folders(bundle, entries, cache):
        try:
            return _checked_source(folder, entries[0], bundle, search), folder
        except VlatoolError as error:
            problem = problem or error
    raise problem or SourceError(
        f"{bundle.path} does not say where its source is (a policy named '{bundle.manifest.name}'), or it is gone.",
        "pass --source SOURCE: the directory of the policy, path.py:make or the .onnx file",
    )


def _checked_source(source: str, entry: Entry, bundle: Bundle, search: _FileSearch) -> Transform:
    """Return the stage of a source whose files have the recorded hashes."""
    stage = source_stage(source)
    if stage.name() != entry["stage"]:
        raise SourceError(
            f"{source} is read by {stage.name()}; {bundle.path} was made by {entry['stage']}.",
            f"pass what {entry['stage']} reads: --source",
        )
    named = {name: value for name, value in entry.get("options", {}).items() if name in RECORDING_OPTIONS}
    found = _with_files(stage.name(), named, search)
    stage = stage.model_copy(update={**found, "map": tuple(found.get("map", ()))}).as_recorded(entry, bundle)
    stage.check(None, None)
    got, recorded = input_hashes(stage), entry.get("files", {})
    wrong = [
        f"{name}: got {_short_hash(got.get(name))}, recorded {_short_hash(recorded.get(name))}"
        for name in dict.fromkeys([*recorded, *got])
        if got.get(name) != recorded.get(name)
    ]
    if wrong:
        more = f"; and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise SourceError(
            f"The source {source} is not what {bundle.path} was made from: {'; '.join(wrong[:5])}{more}.",
            "go back to the recorded files, or make a new bundle from these",
        )
    return stage


def _short_hash(digest: str | None) -> str:
    return f"sha256:{digest[:16]}" if digest else "no such file"


def _noted_folders(bundle: Bundle, entries: tuple[Entry, ...], cache: Path) -> Iterator[str]:
    """Yield where the source may be: as the bundle or the cached source bundle notes."""
    description = next(iter(entries[0].get("files", {})), "policy.yaml")
    source_hash = entries[1].get("input") if len(entries) > 1 else bundle.hash
    cached = [path.parent for path in sorted((cache / "stages").glob(f"{entries[0]['stage']}-*/{MANIFEST}"))]
    refused: SourceError | None = None
    for noted in [bundle.path, *(path for path in cached if f"sha256:{hash_file(path / MANIFEST)}" == source_hash)]:
        try:
            folder = read_location(noted)
        except SourceError:
            continue
        try:
            trust.require(folder, "the policy's code")
        except SourceError as error:
            refused = refused or error
            continue
        yield from (str(folder / description), str(folder))
    if refused:
        raise SourceError(refused.message, f"name the policy: --source DIR; or {refused.fix}")


def _finalize(entry: Entry, bundle: Bundle | None, out: Path) -> Bundle:
    """Seal a candidate as ``optimize`` does; what it measured and decided is taken from the record."""
    bundle = source_of(bundle, OPTIMIZE)
    out.mkdir()
    manifest = replace(
        bundle.manifest,
        parent=bundle.hash,
        made_by={**bundle.manifest.made_by, **entry.get("options", {})},
        source={},
        files={graph.file: bundle.manifest.files[graph.file] for graph in bundle.manifest.graphs.values()},
        **{name: entry[name] for name in FINALIZED_FIELDS if name in entry},
    )
    return reseal(bundle, out, manifest, ROBOT_FOLDERS)


def _graphs_as_recorded(entry: Entry, bundle: Bundle) -> bool:
    files = {name: record.sha256 for name, record in bundle.manifest.files.items()}
    return all(files.get(name) == digest for name, digest in entry.get("graphs", {}).items())
