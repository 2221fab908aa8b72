"""``vlatool hwselect``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vlatool.cli import _complete
from vlatool.cli._console import file_or_none, progress, refuse_existing, show
from vlatool.cli._default import group_with
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BundleOrSource, Force, ReportFolder
from vlatool.errors import UsageError

if TYPE_CHECKING:
    from vlatool.boards.answer import Asked

app = typer.Typer(
    cls=group_with("select"), no_args_is_help=True, rich_markup_mode=None,
    help="Find the boards that can run a policy, and the precision to use: vlatool hwselect SOURCE --hz 20.",
)  # fmt: skip

Profiles = Annotated[
    list[str] | None, typer.Option(help="use only this profile; may be repeated", autocompletion=_complete.profiles)
]
POINTS = "published latencies: a CSV file with device, device_class, runtime, model, precision, metric, value"


@app.command("select")
def select(
    source: BundleOrSource,
    hz: Annotated[
        float | None,
        typer.Option(
            help="inferences per second; the policy's control rate when neither this nor --latency-ms is given"
        ),
    ] = None,
    per_chunk: Annotated[
        bool,
        typer.Option(
            "--per-chunk",
            help="--hz is the control rate, and an inference may take as long as the executed actions of a chunk",
        ),
    ] = False,
    latency_ms: Annotated[float | None, typer.Option(help="time limit of one inference")] = None,
    max_watts: Annotated[float | None, typer.Option(help="limit of the board's power mode")] = None,
    max_price: Annotated[float | None, typer.Option(help="US dollars")] = None,
    memory: Annotated[float | None, typer.Option(help="memory that the policy may use, GB")] = None,
    battery_wh: Annotated[
        float | None, typer.Option(help="the robot's battery, to say how long it powers the board")
    ] = None,
    robots: Annotated[int, typer.Option(min=1, help="number of robots to buy boards for")] = 1,
    years: Annotated[float, typer.Option(help="years that the robots run")] = 3.0,
    hours: Annotated[float, typer.Option(help="hours a day that the robots run")] = 8.0,
    kwh_price: Annotated[float, typer.Option(help="US dollars for a kWh")] = 0.3,
    cloud: Annotated[bool, typer.Option(help="compare with a rented machine")] = False,
    network_ms: Annotated[float, typer.Option(help="round trip to the rented machine")] = 40.0,
    precision: Annotated[
        list[str] | None,
        typer.Option(help="allow only this precision; may be repeated", autocompletion=_complete.precisions),
    ] = None,
    platform: Annotated[
        str | None,
        typer.Option(help="start from a robot platform's rate, power and battery", autocompletion=_complete.platforms),
    ] = None,
    boards: Profiles = None,
    calibration: Annotated[
        Path | None, typer.Option(help="file that `vlatool profiles calibrate` stored; all of them when not given")
    ] = None,
    carry: Annotated[
        bool,
        typer.Option(
            "--carry-count",
            help="write the policy's operation counts to workload.json beside policy.yaml: torch is not needed again",
        ),
    ] = False,
    output: ReportFolder = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Rank the boards that can run a policy at a rate, within power, price and memory. Everything is predicted."""
    from vlatool.boards.answer import Asked, carry_count, select_boards

    asked = Asked(
        hz=hz, latency_ms=latency_ms, watts=max_watts, price=max_price, memory_gb=memory, battery_wh=battery_wh,
        robots=robots, years=years, hours_a_day=hours, kwh_price=kwh_price, network_ms=network_ms,
        precisions=tuple(precision or ()), platform=platform, boards=tuple(boards or ()), cloud=cloud,
        per_chunk=per_chunk,
    )  # fmt: skip
    _check(asked)
    refuse_existing(output, force, source, calibration, *map(file_or_none, boards or ()))
    with progress() as context:
        file = carry_count(source, context) if carry else None
        report = select_boards(source, asked, context, calibration)
    if file:
        typer.echo(f"count kept in {file}", err=True)
    show(report, as_json=as_json, out=output, force=force)


def _check(asked: Asked) -> None:
    """Refuse numbers that mean nothing."""
    above_zero = {
        "hz": asked.hz, "latency-ms": asked.latency_ms, "max-watts": asked.watts, "max-price": asked.price,
        "memory": asked.memory_gb, "battery-wh": asked.battery_wh, "years": asked.years, "hours": asked.hours_a_day,
        "kwh-price": asked.kwh_price,
    }  # fmt: skip
    for name, value in above_zero.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise UsageError(
                f"--{name} is {value:g}; allowed: a number above 0.", "give a number above 0, or leave the option out"
            )
    if not (math.isfinite(asked.network_ms) and asked.network_ms >= 0):
        raise UsageError(
            f"--network-ms is {asked.network_ms:g}; allowed: 0 or more.", "give a time that is not negative"
        )
    if asked.hours_a_day > 24:
        raise UsageError(f"--hours is {asked.hours_a_day:g}; a day has 24.", "give a number above 0, at most 24")


def _finite(**numbers: float) -> None:
    for name, value in numbers.items():
        if not math.isfinite(value):
            raise UsageError(
                f"--{name} is {value:g}; allowed: a number from 0.",
                "give a number that is not negative, or leave the option out",
            )


@app.command("score")
def score(
    points: Annotated[Path, typer.Argument(help=POINTS, show_default=False)],
    held_out: Annotated[
        str | None, typer.Option("--held-out", help="models, devices or calibrated: fit on the rest of this file first")
    ] = None,
    refit: Annotated[
        float | None,
        typer.Option(
            min=0, help="choose the model's scales again without each held-out part, in this many seconds for each"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of the split")] = 0,
    as_json: Annotated[
        bool, typer.Option("--json", help="print JSON on stdout; with --refit a table for each kind")
    ] = False,
) -> None:
    """Predict every row of a file of published latencies, and print error and interval coverage."""
    from vlatool.latency_model.refit import refit_points
    from vlatool.latency_model.score import score_points, summary_lines

    if refit is None:
        found = score_points(points, held_out, seed)
        tables = [found]
    else:
        _finite(refit=refit)
        with progress() as context:
            found = refit_points(points, held_out, seed, refit, context.progress)
        tables = list(found.values())
    answer(as_json, found, [line for table in tables for line in summary_lines(table)])


@app.command("fit")
def fit(
    points: Annotated[Path, typer.Argument(help=POINTS, show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="directory for latency.npz and latency.json", show_default=False)
    ],
    seconds: Annotated[
        float, typer.Option(min=0, help="seconds for the search of the scales; 0 keeps the shipped ones")
    ] = 300.0,
    seed: Annotated[int, typer.Option(min=0, help="seed of the search")] = 0,
    anew: Annotated[
        bool, typer.Option("--anew", help="start the search from built-in scales, not from those of the shipped model")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Fit the latency model on published latencies, and write its data files."""
    from vlatool.latency_model.fit import fit_files

    _finite(seconds=seconds)
    fit_files(points, output, seconds, seed, anew, lambda line: typer.echo(line, err=True))
    answer(as_json, {"written": [str(output / name) for name in ("latency.npz", "latency.json")]}, ())
