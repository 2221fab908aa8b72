"""``vlatool data``."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, Force, MapNames
from vlatool.errors import OutputError, UsageError
from vlatool.files.printable import amount, printable

if TYPE_CHECKING:
    from vlatool.bundle.spec import PolicySpec

app = typer.Typer(help="Look at recordings and datasets, and take samples of them.", no_args_is_help=True,
                  rich_markup_mode=None)  # fmt: skip
DatasetPath = Annotated[
    Path, typer.Argument(help="a recording: LeRobot, HDF5, bag, zarr, RLDS, CSV or npz", show_default=False)
]


@app.command("inspect")
def inspect(
    path: DatasetPath,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="HTML file to write, with pictures of each camera")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Show what a recording holds: episodes, rates, shapes, gaps, values that are not finite, cameras that drift."""
    from vlatool import registry
    from vlatool.data import inspect_steps, inspection_lines, inspection_page, reader_of
    from vlatool.files.user_files import refuse_file, write_own_file

    if output is not None:
        _refuse_inside(output, path)
        refuse_file(output, force=force)
    reader = reader_of(path)
    steps = reader.steps(path)
    inspection = inspect_steps(steps, registry.entry_of(type(reader)).partition(".")[2])
    if output is not None:
        write_own_file(output, inspection_page(inspection, steps), force=force, comment="<!-- {} -->")
    page = [] if output is None else [f"  page       {output}"]
    answer(as_json, asdict(inspection), [*map(printable, inspection_lines(inspection)), *page])


@app.command("sample")
def sample(
    path: DatasetPath,
    output: Annotated[Path, typer.Option("-o", "--output", help=".npz file to write", show_default=False)],
    samples: Annotated[int, typer.Option(min=1, max=1_000_000, help="samples, spread over the recording")] = 128,
    policy: Annotated[
        str, typer.Option(help="policy or bundle that the samples are for: names and chunks of its spec")
    ] = "",
    map: MapNames = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write samples of a recording as .npz, spread over tasks, episodes and phases of an episode.

    With --policy they are inputs and actions of that policy. Without it every column is written under its own name, or
    that of --map.
    """
    from vlatool.data import named_recording, sample_columns, sample_recording
    from vlatool.files.user_files import atomic_file

    if output.suffix != ".npz":
        raise UsageError(f"--output is {output}; samples are written as .npz.", f"write --output {output.stem}.npz")
    _refuse_inside(output, path)
    _refuse_sample(output, force=force)
    named = named_recording(path, map or ())
    if named is None:
        raise UsageError("No recording is named.", "name a file or a directory")
    spec = _spec_of(policy) if policy else None
    output.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(output) as draft:
        count = sample_columns(named, samples, draft) if spec is None else sample_recording(named, samples, spec, draft)
    answer(as_json, {"written": [str(output)]}, [f"{output}: {amount(count, 'sample')} of {path}"])


def _spec_of(policy: str) -> PolicySpec:
    from vlatool.bundle.bundle import Bundle
    from vlatool.cli._console import progress
    from vlatool.machine.host import cache_directory
    from vlatool.sources import open_source, source_bundle

    source = open_source(policy)
    if not isinstance(source, Bundle) and (described := source.describe()) is not None:
        return described.spec
    with progress() as context:
        return source_bundle(source, cache_directory(), context).bundle.manifest.spec


def _refuse_inside(output: Path, path: Path) -> None:
    """Refuse to write a file into the recording, or in its place."""
    target, recording = output.resolve(), path.resolve()
    if target == recording or (recording.is_dir() and target.is_relative_to(recording)):
        raise OutputError(f"{output} is in the recording {path}, which is not changed.", "write it elsewhere")


def _refuse_sample(output: Path, *, force: bool) -> None:
    """Refuse to replace a file, unless it is a sample of vlatool's and ``force`` is set."""
    from vlatool.data import is_sample

    if not os.path.lexists(output):
        return
    if not force:
        raise OutputError(f"{output} exists already.", "choose another file, or pass --force to replace it")
    if output.is_symlink() or not is_sample(output):
        raise OutputError(
            f"{output} was not written by vlatool, so --force does not replace it.",
            "choose another file, or move it away yourself",
        )
