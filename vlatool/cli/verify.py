"""``vlatool verify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool.cli._console import progress, refuse_existing, show
from vlatool.cli._options import AsJson, Force, MapNames, ReportFolder


def verify(
    source: Annotated[str, typer.Argument(help="policy directory, path.py:make or a bundle", show_default=False)],
    against: Annotated[
        str, typer.Option(help="path.py:FUNCTION or package.module:FUNCTION of the original", show_default=False)
    ],
    data: Annotated[Path | None, typer.Option(help="recorded observations; the policy's own when not given")] = None,
    map: MapNames = None,
    samples: Annotated[int, typer.Option(min=1, max=100_000, help="observations at most, spread over the data")] = 32,
    tolerance: Annotated[float, typer.Option(help="largest relative error of an action, and of each stage")] = 1e-3,
    seed: Annotated[int, typer.Option(min=0, help="seed of the noise that both are given")] = 0,
    output: ReportFolder = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Check whether a policy computes what its original code computes, and if not, show which stage differs.

    FUNCTION takes an observation (a dict of physical values, without a batch axis) and returns the action in physical
    units. Exits 1 when the actions differ.
    """
    from vlatool.data import named_recording
    from vlatool.machine.host import cache_directory
    from vlatool.sources import open_source, source_bundle
    from vlatool.verify import Options, check
    from vlatool.verify import verify as verify_policy

    refuse_existing(output, force, source, data)
    named = named_recording(data, map or ())
    options = Options(against, data, samples, tolerance, seed, named.names if named else {})
    check(options)
    with progress() as context:
        bundle = source_bundle(open_source(source), cache_directory(), context).bundle
        report = verify_policy(bundle, options, context)
    show(report, as_json=as_json, out=output, force=force)
