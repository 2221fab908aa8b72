"""``vlatool profiles``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Annotated, Any

import typer

app = typer.Typer(
    help="Hardware profiles: what a board has and what it allows.", no_args_is_help=True, rich_markup_mode=None
)


@app.command("list")
def list_profiles(as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False) -> None:
    """List the profiles."""
    from vlatool.profile import load_profile, names

    found = [load_profile(name) for name in names()]
    if as_json:
        typer.echo(json.dumps([profile.model_dump(mode="json") for profile in found]))
        return
    for profile in found:
        typer.echo(f"{profile.name:22} {profile.title}")


@app.command("show")
def show_profile(
    name: Annotated[str, typer.Argument(help="name of a profile, or a YAML file", show_default=False)],
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Print one profile with the source of every figure."""
    from vlatool.profile import load_profile

    profile = load_profile(name)
    if as_json:
        typer.echo(json.dumps(profile.model_dump(mode="json")))
        return
    typer.echo(f"{profile.title} ({profile.name})")
    for line in _lines(profile.model_dump(mode="json", exclude={"name", "title", "sources"}, exclude_none=True), "  "):
        typer.echo(line)
    typer.echo("  sources")
    for key, text in profile.sources.items():
        typer.echo(f"    [{key}] {text}")


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
