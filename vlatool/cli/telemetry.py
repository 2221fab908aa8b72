"""``vlatool telemetry``."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli._document import answer
from vlatool.errors import DataError, UsageError
from vlatool.files.messages import to_json

if TYPE_CHECKING:
    from vlatool.telemetry import Summary

LONGEST_S = 86_400.0


def telemetry(
    seconds: Annotated[float, typer.Option(help="how long to watch")] = 2.0,
    period: Annotated[float, typer.Option(help="seconds between two samples")] = 0.1,
    root: Annotated[Path, typer.Option(help="file system to read, such as a copied tree")] = Path("/"),
    as_json: Annotated[bool, typer.Option("--json", help="print JSON on stdout, with every sample")] = False,
) -> None:
    """Watch power, energy, temperatures, clocks and throttling, and list what this machine does not report."""
    from vlatool.telemetry import Recorder, open_all

    for name, value in (("seconds", seconds), ("period", period)):
        if not (math.isfinite(value) and 0 < value <= LONGEST_S):
            raise UsageError(
                f"--{name} is {value:g}; allowed: above 0, up to {LONGEST_S:g}.", f"give seconds up to {LONGEST_S:g}"
            )
    if not root.is_dir():
        raise DataError(f"No such directory: {root}.", "check the path; leave --root out to read this machine")
    with Recorder(open_all(root), period) as recorder:
        time.sleep(seconds)
    answer(as_json, to_json(recorder.summary), lines(recorder.summary))


def lines(recorded: Summary) -> Iterator[str]:
    """Return what a person reads: energy first, then every reading, then what is unmeasured and why."""
    for energy in recorded.energy:
        power = f"{energy.mean_w:.3g} W, {energy.joules:.3g} J in {energy.seconds:.1f} s"
        yield f"{power}: {energy.label} ({energy.source})"
    throttled = {None: "not reported by this machine", False: "no"}.get(
        recorded.throttled, "; ".join(recorded.throttling)
    )
    yield f"throttled: {throttled}"
    for name, gauge in sorted(recorded.gauges.items()):
        span = f" ({gauge.min:.4g} to {gauge.max:.4g})" if gauge.min != gauge.max else ""
        yield f"  {name}: {gauge.mean:.4g} {gauge.unit}{span}"
    for name, counter in sorted(recorded.counters.items()):
        yield f"  {name}: +{counter.difference:.4g} {counter.unit} in {counter.seconds:.1f} s"
    if recorded.unmeasured:
        yield "unmeasured:"
    for absent in recorded.unmeasured:
        yield f"  {absent.reader}: {absent.reason}"
