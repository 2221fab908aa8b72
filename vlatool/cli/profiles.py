"""``vlatool profiles``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.cli import _complete
from vlatool.cli._document import answer, document
from vlatool.cli._options import AsJson, ProfileName

app = typer.Typer(
    help="Hardware profiles: what a board has and what its limits are.", no_args_is_help=True, rich_markup_mode=None
)


@app.command("list")
def list_profiles(as_json: AsJson = False) -> None:
    """List the profiles."""
    from vlatool.hardware.profile import load_profile, profile_names

    profiles = [load_profile(name) for name in profile_names()]
    width = max((len(profile.name) for profile in profiles), default=0)
    lines = [f"{profile.name:{width}}  {profile.title}" for profile in profiles]
    answer(as_json, [profile.model_dump(mode="json") for profile in profiles], lines)


@app.command("show")
def show_profile(name: ProfileName, as_json: AsJson = False) -> None:
    """Print one profile with the source of every figure."""
    from vlatool.hardware.profile import load_profile

    profile = load_profile(name)
    shown = profile.model_dump(mode="json", exclude={"name", "title", "sources"}, exclude_none=True)
    sources = [f"    [{key}] {text}" for key, text in profile.sources.items()]
    lines = [f"{profile.title} ({profile.name})", *_lines(shown, "  "), "  sources", *sources]
    answer(as_json, profile.model_dump(mode="json"), lines)


@app.command("diff")
def diff_profiles(
    first: ProfileName,
    second: Annotated[str, typer.Argument(help="another one", show_default=False, autocompletion=_complete.profiles)],
    as_json: AsJson = False,
) -> None:
    """Print where two profiles differ: field, first, second."""
    from vlatool.hardware.profile import load_profile

    pair = [dict(_leaves(load_profile(name).model_dump(mode="json", exclude={"sources"}))) for name in (first, second)]
    rows = [
        {"field": field, first: pair[0].get(field), second: pair[1].get(field)}
        for field in dict.fromkeys([*pair[0], *pair[1]])
        if pair[0].get(field) != pair[1].get(field)
    ]
    lines = [f"{row['field']:44} {_cell(row[first]):>24} {_cell(row[second]):>24}" for row in rows]
    answer(as_json, rows, lines or ["no difference"])


@app.command("validate")
def validate_profiles(
    files: Annotated[
        list[str],
        typer.Argument(
            help="YAML files, directories of them, or names", show_default=False, autocompletion=_complete.profiles
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Check profiles against the schema; exit 3 when one is wrong, naming every field that is."""
    from vlatool.errors import ProfileError
    from vlatool.hardware.profile import SUFFIXES, load_profile

    valid, wrong = [], []
    for name in files:
        path = Path(name)
        inside = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES) if path.is_dir() else [name]
        if not inside:
            raise ProfileError(f"No profiles in {path}.", "its files end in .yaml")
        for file in inside:
            try:
                profile = load_profile(file)
            except ProfileError as error:
                wrong.append(error.message)
            else:
                valid.append(profile.name)
                if not as_json:
                    typer.echo(f"ok  {profile.name}")
    if as_json:
        document({"valid": valid, "wrong": wrong})
    if wrong:
        raise ProfileError("\n".join(wrong), "correct these lines")


@app.command("new")
def new_profile(
    name: Annotated[str, typer.Argument(help="name of the new profile", show_default=False)],
    like: Annotated[
        str, typer.Option("--from", help="profile to copy", autocompletion=_complete.profiles)
    ] = "raspberry-pi-5",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="file; NAME.yaml when not given")] = None,
    force: Annotated[bool, typer.Option("--force", help="replace a file that exists")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a profile of your own to edit: another one's figures under a new name."""
    from vlatool.hardware.profile import copy_profile

    target = output or Path(f"{name}.yaml")
    copy_profile(like, name, target, force=force)
    validate = f"{target}: correct its figures, then: vlatool profiles validate {target}"
    advice = "put it into a directory named in VLATOOL_PROFILES to find it by name"
    answer(as_json, {"written": [str(target)]}, [validate, advice])


@app.command("calibrate")
def calibrate_profile(
    name: ProfileName,
    report: Annotated[
        Path, typer.Option("--from", help="report of `vlatool benchmark` on the board", show_default=False)
    ],
    mode: Annotated[str | None, typer.Option(help="power mode that it ran in; the default one when not given")] = None,
    bundle: Annotated[Path | None, typer.Option(help="measured precision, if the report does not say")] = None,
    as_json: AsJson = False,
) -> None:
    """Give the latency model a measurement on a board, on which its predictions are based from now on."""
    from vlatool.bundle.bundle import Bundle
    from vlatool.graph.workload import workload
    from vlatool.hardware.profile import load_profile
    from vlatool.latency_model.board_measurements import calibrations, foreign_host, report_measurements, store

    load = workload(Bundle.open(bundle)) if bundle else None
    profile = load_profile(name)
    measured = report_measurements(report, profile, mode, load)
    file = store(measured)
    if as_json:
        document({"kept_in": str(file), "measured": [asdict(point) for point in measured]})
    for point in [] if as_json else measured:
        typer.echo(f"{point.profile}, {point.mode}, {point.engine}, {point.precision}: {point.ms:.4g} ms measured")
    if made_on := foreign_host(report, profile):
        typer.echo(f"warning: the report was made on {made_on}, which {name} does not name in model_strings", err=True)
    if not as_json:
        typer.echo(f"kept in {file}; remove the file to forget it, or set VLATOOL_CALIBRATIONS (now {calibrations()})")


def _leaves(values: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted path, value); a figure counts as its value."""
    if isinstance(values, dict) and {"value", "kind", "source"} <= set(values):
        yield where, values["value"]
    elif isinstance(values, dict):
        for key, value in values.items():
            yield from _leaves(value, f"{where}.{key}" if where else key)
    elif isinstance(values, list) and not any(isinstance(item, dict) for item in values):
        yield where, ", ".join(map(str, values))
    elif not isinstance(values, list):
        yield where, values


def _cell(value: Any) -> str:
    text = "–" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 24 else text[:23] + "…"


def _lines(values: dict[str, Any], indent: str) -> Iterator[str]:
    """Print nested values as an outline; a figure on one line with its kind and source."""
    for key, value in values.items():
        if isinstance(value, dict) and {"value", "kind", "source"} <= set(value):
            rest = f" {value['year']}" if "year" in value else ""
            note = f"  {value['note']}" if value.get("note") else ""
            yield f"{indent}{key:20} {value['value']:<8g} {value['kind']}{rest} [{value['source']}]{note}"
        elif isinstance(value, dict):
            yield f"{indent}{key}"
            yield from _lines(value, indent + "  ")
        elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
            yield f"{indent}{key}"
            for item in value:
                yield indent + "  - " + ", ".join(f"{name}: {part}" for name, part in item.items())
        elif value not in ("", []):
            text = ", ".join(map(str, value)) if isinstance(value, list) else value
            yield f"{indent}{key:20} {text}"
