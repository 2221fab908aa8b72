"""Run a stage: input directory, stage, output directory."""

from __future__ import annotations

import contextlib
import os
import shutil
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import cast

from vlatool.bundle.bundle import REPORTS, Bundle
from vlatool.bundle.module_bundle import factory_of
from vlatool.errors import BundleError, DataError, RecipeError
from vlatool.files.blob_store import mark_cache
from vlatool.files.directory_writer import write_directory
from vlatool.files.locks import acquire
from vlatool.files.outputs import BUNDLE, refuse_replacing
from vlatool.files.resumable_work import remove_all_unused
from vlatool.machine.host import cache_directory as cache_directory
from vlatool.report import REPORT, Report, read_report
from vlatool.stage import first_run
from vlatool.stage._child import child_imports, run_in_child
from vlatool.stage._child import measure_in_child as measure_in_child
from vlatool.stage.base import Context, Measure, Result, Stage, Transform, source_of
from vlatool.stage.cache import STREAMS
from vlatool.user_code import children


def run_transform(
    stage: Transform,
    source: Bundle | None,
    out: Path,
    context: Context,
    *,
    force: bool = False,
    damaged: bool = False,
    reports: Path | None = None,
) -> Result:
    """Run a stage that makes a bundle; ``out`` appears whole or not at all.

    A stage that opens graphs, or starts from a policy's own code, runs in a child process.

    Args:
        source: its input; None for a stage that starts a chain.
        force: whether to replace a directory that vlatool wrote.
        damaged: see ``vlatool.files.directory_writer.write_directory``.
        reports: directory of reports of a stage before it, which come along where this one writes none.

    Raises:
        RecipeError: when other stages are to run first (``vlatool.stage.chain``).
        VlatoolError: what the stage raises, and OutputError when the output cannot be written.
    """
    apart = stage.runs_graphs or bool(factory_of(source))
    if apart and not factory_of(source):
        imports = child_imports(stage)
        children.prepare(imports)  # while this process checks
    if not damaged:
        refuse_replacing(out, force=force, kind=BUNDLE)
    if first := stage.chain().before:
        raise RecipeError(
            f"{stage.name()} with these options is several stages: {', '.join((*first, stage.name()))}.",
            "run one after the other what vlatool.stage.chain.steps_of() returns, as the command line does",
        )
    if stage.kind() != "sources":
        source_of(source, stage.name())
    stage.check(source, None)
    with write_directory(out, force=force, damaged=damaged) as draft:
        result = (
            run_in_child(stage, source, draft, context) if apart else stage.run(cast(Bundle, source), draft, context)
        )
        for report in reports.iterdir() if reports is not None and reports.is_dir() else ():
            (draft / REPORTS).mkdir(exist_ok=True)
            if report.is_file() and not (draft / REPORTS / report.name).exists():
                shutil.copy2(report, draft / REPORTS)
    made = replace(result, bundle=Bundle.open(out, verify=False))
    if apart:
        first_run.remember_run(made.bundle)
    return made


def cached_path(stage: Stage, source_hash: str, cache: Path) -> Path:
    """Return where the output of a stage is kept."""
    return cache / "stages" / f"{stage.name()}-{stage.key(source_hash)}"


def work_folder(stage: Stage, source: Bundle) -> Path:
    """Return the folder of the unfinished work of a stage on a source."""
    return cache_directory() / STREAMS / cached_path(stage, source.hash, Path()).name


def cached_transform(stage: Transform, source: Bundle | None, cache: Path, context: Context) -> Result:
    """Return the stage's bundle from the cache, without messages, or run the stage into the cache."""
    path = cached_path(stage, source.hash if source else "", cache)
    if acquire(path):
        try:
            return Result(Bundle.open(path))
        except BundleError:
            context.progress(f"the cached {stage.name()} is damaged; making it again", None)
    mark_cache(cache)
    result = run_transform(stage, source, path, context, damaged=True)
    acquire(path)
    return result


def report_of(stage: Measure, source: Bundle, context: Context) -> Report:
    """Run a stage that measures; in a child process where it opens graphs itself."""
    return measure_in_child({}, stage, source, context) if stage.runs_graphs else stage.run(source, context)


def cached_measure(stage: Measure, source: Bundle, cache: Path, context: Context, *, fresh: bool = False) -> Report:
    """Return the stage's report from the cache, or measure (always, when ``fresh``) and keep it."""
    path = cached_path(stage, source.hash, cache)
    if path.is_dir() and not fresh:
        try:
            report = read_report(path)
            with contextlib.suppress(OSError):  # a cache that may only be read
                os.utime(path)
            return report
        except DataError:
            context.progress(f"the cached {stage.name()} is damaged; measuring again", None)
    work = cache_directory() / STREAMS / path.name
    measured = report_of(stage, source, replace(context, work=str(work.absolute())))
    report = replace(measured, created=datetime.now(timezone.utc).isoformat(timespec="seconds"))
    mark_cache(cache)
    with write_directory(path, damaged=True) as draft:
        (draft / REPORT).write_text(report.to_json(), encoding="utf-8")
    remove_all_unused([work])
    return report
