"""``vlatool verify``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli._console import progress, refuse_existing, show
from vlatool.cli._options import AsJson, Force, MapNames, ReportFolder
from vlatool.errors import UsageError
from vlatool.report import Report

if TYPE_CHECKING:
    from vlatool.verify import Options


def verify(
    source: Annotated[str, typer.Argument(help="policy directory, path.py:make or a bundle", show_default=False)],
    against: Annotated[
        str | None, typer.Option(help="path.py:FUNCTION or package.module:FUNCTION of the original", show_default=False)
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="recording of what the robot fed and did: is it wired right?", show_default=False),
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(help="with --log: recording of right wiring; the policy's own when not given")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="recorded observations; the policy's own when not given")] = None,
    map: MapNames = None,
    samples: Annotated[int, typer.Option(min=1, max=100_000, help="observations at most, spread over the data")] = 32,
    tolerance: Annotated[float, typer.Option(help="largest relative error of an action, and of each stage")] = 1e-3,
    seed: Annotated[int, typer.Option(min=0, help="seed of the noise that both are given")] = 0,
    output: ReportFolder = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Check whether a policy computes what its original code computes, or with --log, whether a robot is wired right.

    With --against: FUNCTION takes an observation (a dict of physical values, without a batch axis) and returns the
    action in physical units; the stage that differs is named. With --log: each input of the log is compared with a
    reference recording, and commands with what the policy gives; what is permuted, negated, of another unit, late,
    swapped, normalised wrong or BGR is named. Exits 1 when something differs, and 5 when that
    may be right.
    """
    from vlatool.data import named_recording
    from vlatool.verify import Options, check

    refuse_existing(output, force, source, data, log, reference)
    if (against is None) == (log is None):
        got = "neither" if log is None else "both"
        raise UsageError(
            f"verify takes one of --against and --log; got {got}.",
            "--against original.py:act compares with original code, --log RECORDING judges the wiring of a robot",
        )
    if log is not None:
        if data is not None or map:
            raise UsageError(
                "--data and --map are for --against; --log reads its own recordings.", "leave them out, or --reference"
            )
        report = _of_log(source, log, reference, samples)
    else:
        if reference is not None:
            raise UsageError("--reference is for --log; --against compares with code.", "leave it out, or use --data")
        named = named_recording(data, map or ())
        options = Options(str(against), data, samples, tolerance, seed, named.names if named else {})
        check(options)
        report = _of_code(source, options)
    show(report, as_json=as_json, out=output, force=force)


def _of_code(source: str, options: Options) -> Report:
    """Return what was found when a policy and its original code ran on the same observations."""
    from vlatool.machine.host import cache_directory
    from vlatool.sources import open_source, source_bundle
    from vlatool.verify import verify as verify_policy

    with progress() as context:
        bundle = source_bundle(open_source(source), cache_directory(), context).bundle
        return verify_policy(bundle, options, context)


def _of_log(source: str, log: Path, reference: Path | None, samples: int) -> Report:
    """Return what was found in the log of a robot."""
    from vlatool.machine.host import cache_directory
    from vlatool.sources import open_source, source_bundle
    from vlatool.verify.log import LogOptions, verify_log

    with progress() as context:
        bundle = source_bundle(open_source(source), cache_directory(), context).bundle
        return verify_log(bundle, LogOptions(log, reference, samples), context)
