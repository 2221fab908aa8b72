"""``vlatool rebuild``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.cli import _complete
from vlatool.cli._console import progress, refuse_existing
from vlatool.cli._document import document, put
from vlatool.cli._options import AsJson, Force
from vlatool.errors import GateFailed, UsageError
from vlatool.files.outputs import BUNDLE
from vlatool.files.printable import amount

if TYPE_CHECKING:
    from vlatool.rebuild.rebuild import RebuildResult

SAME_VERSIONS = "the versions are the recorded ones"
CHANGED_BUNDLE = "the bundle was changed after it was made"
OTHER_PROCESSOR_FIX = "check on the kind of processor that made the bundle, since others round otherwise"
Versions = dict[str, tuple[str, str]]


def rebuild(
    bundle: Annotated[
        Path,
        typer.Argument(
            help="a bundle that a stage or optimize made", show_default=False, autocompletion=_complete.bundles
        ),
    ],
    source: Annotated[
        str | None,
        typer.Option(
            help="policy directory, path.py:make, .onnx file or an earlier bundle; its former location if unset",
            autocompletion=_complete.sources,
        ),
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="exit 1 when a byte differs")] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write the rebuilt bundle here")] = None,
    file: Annotated[
        list[Path] | None, typer.Option(help="file that an option named (calibration), if it is not beside the source")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Make a bundle again from its build record, without the cache, and compare it byte by byte.

    Exits 0 when all is identical, 1 with --check when a file differs, 3 when the source is not the recorded one.
    """
    from vlatool.rebuild.rebuild import build_record, version_changes
    from vlatool.rebuild.rebuild import rebuild as run
    from vlatool.stage.run import cache_directory

    if not check and output is None:
        raise UsageError("rebuild has nothing to do.", "pass --check to compare, -o OUT to keep the bundle, or both")
    refuse_existing(output, force, bundle, source, *(file or ()), kind=BUNDLE)
    opened = Bundle.open(bundle)
    versions = version_changes(build_record(opened))
    if versions and not as_json:
        put(f"versions differ from the recorded ones: {_shifts(versions)}\n")
    with progress() as context:
        files = tuple(file or ())
        rebuilt = run(opened, context, source=source, files=files, cache=cache_directory(), out=output, force=force)
    if as_json:
        document(_as_json(rebuilt, versions, output))
    else:
        put(_text(rebuilt, versions, output))
    if check and not rebuilt.identical:
        _fail(rebuilt, versions)


def _shifts(versions: Versions) -> str:
    return ", ".join(f"{name} {recorded} recorded, {now} installed" for name, (recorded, now) in versions.items())


def _text(rebuilt: RebuildResult, versions: Versions, output: Path | None) -> str:
    lines = [
        f"source    {rebuilt.source}",
        f"stages    {' -> '.join(name for name, _ in rebuilt.stages)}",
        f"versions  {'not as recorded' if versions else 'as recorded'}",
    ]
    measured = [f"{', '.join(rebuilt.left_out)} in manifest.json: measured, so not the same twice"]
    beside = [f"{', '.join(rebuilt.files_beside)}: in no hash"]
    if left_out := [*(measured if rebuilt.left_out else []), *(beside if rebuilt.files_beside else [])]:
        lines.append(f"left out  {'; '.join(left_out)}")
    width = max(len(item.file) for item in rebuilt.files)
    lines += ["", f"{'file':<{width}}  {'bytes':>12}  identical"]
    lines += [f"{item.file:<{width}}  {item.bytes:>12}  {'yes' if item.identical else 'NO'}" for item in rebuilt.files]
    differing = [item for item in rebuilt.files if not item.identical]
    lines += ["", *(f"{item.file}: {item.why}" for item in differing)]
    total = sum(item.bytes for item in rebuilt.files)
    if differing:
        lines.append(
            f"differs: {len(differing)} of {amount(len(rebuilt.files), 'file')}; "
            f"{rebuilt.bundle.hash[:19]} is {rebuilt.hash[:19]}"
        )
    else:
        lines.append(f"identical: {amount(len(rebuilt.files), 'file')}, {total} bytes, {rebuilt.hash}")
    return "\n".join([*lines, *([f"bundle: {output}"] if output else [])]) + "\n"


def _as_json(rebuilt: RebuildResult, versions: Versions, output: Path | None) -> dict[str, Any]:
    return {
        "bundle": str(rebuilt.bundle.path),
        "source": rebuilt.source,
        "identical": rebuilt.identical,
        "hash": {"recorded": rebuilt.bundle.hash, "rebuilt": rebuilt.hash},
        "left_out": list(rebuilt.left_out),
        "versions": {name: {"recorded": one, "installed": two} for name, (one, two) in versions.items()},
        "stages": [{"stage": name, "graphs_identical": same} for name, same in rebuilt.stages],
        "files": [
            {"file": item.file, "bytes": item.bytes, "identical": item.identical, "why": item.why}
            for item in rebuilt.files
        ],
        "output": str(output) if output else None,
    }


def _fail(rebuilt: RebuildResult, versions: Versions) -> None:
    """Raise for the first file that differs."""
    first = rebuilt.first_difference
    if first is None:
        return
    since = f" The graphs differ since {rebuilt.differs_since}." if rebuilt.differs_since else ""
    if versions:
        cause = f"the likely cause are the versions ({_shifts(versions)}); install the recorded ones"
    elif since:
        code = "on the same kind, look for random numbers or the time in the policy's code"
        cause = f"{SAME_VERSIONS}: {OTHER_PROCESSOR_FIX}; {code}"
    elif rebuilt.machine_may_differ:
        goldens = "golden outputs and tolerances are of one machine"
        cause = f"{SAME_VERSIONS}, and so are the graphs; {goldens}: there, {CHANGED_BUNDLE}"
    else:
        cause = f"{SAME_VERSIONS}, and every stage gave the recorded graphs: {CHANGED_BUNDLE}"
    raise GateFailed(f"{first.file} differs: {first.why}.{since}", cause)
