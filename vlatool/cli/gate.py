"""``vlatool gate``."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.cli import _complete
from vlatool.cli._console import command_line, crew, progress, refuse_existing, show
from vlatool.cli._default import group_with
from vlatool.cli._document import document, put
from vlatool.cli._options import AsJson, Force, MapNames, Raw, ReportFolder, Workers
from vlatool.cli._run import open_with_graphs
from vlatool.errors import BundleError, OutputError, UsageError
from vlatool.files.outputs import output_errors, refuse_inputs
from vlatool.files.user_files import refuse_file, write_own_file
from vlatool.machine.host import cache_directory
from vlatool.stage.cache import STREAMS

if TYPE_CHECKING:
    from vlatool.gate.config import Gate
    from vlatool.report import Report

app = typer.Typer(
    cls=group_with("run"), no_args_is_help=True, rich_markup_mode=None,
    help="Compare a candidate with a baseline, both measured side by side: vlatool gate CANDIDATE --baseline BUNDLE.",
)  # fmt: skip
CONFIG = Path("gate.yaml")


@app.command("run")
def run(
    candidate: Annotated[
        str,
        typer.Argument(
            help="a bundle, or a policy that is exported first", show_default=False, autocompletion=_complete.sources
        ),
    ],
    baseline: Annotated[
        Path | None,
        typer.Option(help="bundle to compare with; the one in the gate if unset", autocompletion=_complete.bundles),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="the gate (see: vlatool gate init); gate.yaml here, or the defaults, if unset")
    ] = None,
    margin: Annotated[
        float | None, typer.Option(min=0, max=10, help="largest slowdown of the median, a share (0.05 = 5 %)")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="seed of observations, noise and order; random, and in the report, if unset"),
    ] = None,
    map_names: MapNames = None,
    output: ReportFolder = None,
    junit: Annotated[Path | None, typer.Option(help="also write JUnit XML to this file")] = None,
    workers: Workers = None,
    force: Force = False,
    as_json: AsJson = False,
    raw: Raw = False,
) -> None:
    """Measure the baseline again beside the candidate, and exit with 0 (pass), 1 (fail) or 5 (inconclusive).

    In a job of GitHub Actions it also prints annotations and writes the step summary.
    """
    from vlatool.gate.run import run_gate

    gate = _gate(config, margin, map_names or ())
    base = baseline or gate.baseline
    if base is None:
        raise UsageError(
            "No baseline to compare with.", "pass --baseline BUNDLE, or name it in the gate (baseline: PATH)"
        )
    if not base.exists():
        raise BundleError(f"No baseline at {base}.", f"make one: vlatool export POLICY -o {base}")
    inputs = (candidate, base, *gate.paths, config)
    refuse_existing(output, force, *inputs)
    if junit is not None:
        _check_junit(junit, inputs)
    with progress(*crew(workers)) as context:
        bundle = open_with_graphs(candidate, context)
        work = cache_directory() / STREAMS / f"gate-{bundle.hash[-16:]}"
        report = run_gate(bundle, Bundle.open(base), gate, replace(context, work=str(work.absolute())), seed)
    report = replace(report, command=command_line(), created=datetime.now(timezone.utc).isoformat(timespec="seconds"))
    if os.environ.get("GITHUB_ACTIONS") == "true" and not as_json:
        _tell_github(report)
    try:
        show(report, as_json=as_json, out=output, force=force, raw=raw, unfinished=[work])
    finally:  # after the directory of reports: the file may be in it
        if junit is not None:
            from vlatool.render import render

            write_own_file(junit, render(report, "junit"), force=True, comment="<!-- {} -->")


@app.command("init")
def init(
    directory: Annotated[Path, typer.Argument(help="root of the repository")] = Path(),
    baseline: Annotated[Path, typer.Option(help="bundle to compare with, relative to the repository")] = Path(
        "models/baseline"
    ),
    candidate: Annotated[Path, typer.Option(help="bundle that a change produces, relative to the repository")] = Path(
        "policy"
    ),
    force: Annotated[bool, typer.Option("--force", help="replace files that exist")] = False,
    as_json: AsJson = False,
) -> None:
    """Write gate.yaml, and a job for GitHub Actions and for GitLab that runs it."""
    from vlatool.gate.files import gate_files

    files = {directory / name: text for name, text in gate_files(baseline.as_posix(), candidate.as_posix()).items()}
    for path in files:
        refuse_file(path, force=force)
    with _folders(files):
        for path, text in files.items():
            with output_errors(path):
                write_own_file(path, text, force=force)
    if as_json:
        document({"written": [str(path) for path in files]})
        return
    for path in files:
        put(f"written: {path}\n")
    put("GitLab reads its job when .gitlab-ci.yml says: include: {local: .gitlab/policy-gate.yml}\n")
    put(f"next: vlatool gate {shlex.quote(str(candidate))}   # in {directory.absolute()}\n")


@contextlib.contextmanager
def _folders(files: Iterable[Path]) -> Iterator[None]:
    """Make the folders of files; of these, remove what stays empty when they cannot be written."""
    folders = sorted(
        {folder for path in files for folder in path.absolute().parents}, key=lambda folder: len(folder.parts)
    )
    absent = [folder for folder in folders if not folder.exists()]
    try:
        for folder in absent:
            with output_errors(folder):
                folder.mkdir(exist_ok=True)
        yield
    except BaseException:
        for folder in reversed(absent):
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _gate(config: Path | None, margin: float | None, map_names: Sequence[str]) -> Gate:
    from vlatool.data import named_recording
    from vlatool.gate.config import Gate, read_gate

    gate = read_gate(config or CONFIG) if config or CONFIG.is_file() else Gate()
    gate = gate if margin is None else gate.with_options("latency", margin=margin)
    data = getattr(gate.claims.get("accuracy"), "data", None)
    named = named_recording(data, map_names)
    return gate.with_options("accuracy", map=dict(named.names)) if named is not None and map_names else gate


def _check_junit(junit: Path, inputs: Iterable[str | Path | None]) -> None:
    """Refuse, before the work, a file that cannot be written, lies in an input, or is not vlatool's to replace."""
    if junit.is_dir():
        raise OutputError(f"--junit {junit} is a directory.", "name a file")
    above = next(folder for folder in junit.absolute().parents if folder.exists())
    if not (above.is_dir() and os.access(above, os.W_OK)):
        raise OutputError(
            f"--junit {junit} cannot be written: {above} is not a writable directory.",
            "name a file in a directory that exists and may be written to",
        )
    refuse_inputs(junit, inputs)
    if os.path.lexists(junit):
        refuse_file(junit, force=True)


def _tell_github(report: Report) -> None:
    from vlatool.render import render

    put(render(report, "github"))
    if summary := os.environ.get("GITHUB_STEP_SUMMARY"):
        try:
            with Path(summary).open("a", encoding="utf-8") as stream:
                stream.write(render(report, "markdown"))
        except OSError as error:  # the verdict is worth more
            typer.echo(f"warning: the step summary {summary} cannot be written: {error.strerror}", err=True)
