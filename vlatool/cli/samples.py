"""``vlatool samples``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vlatool import registry
from vlatool.cli import _complete
from vlatool.cli._console import progress, refuse_existing
from vlatool.cli._document import document
from vlatool.errors import MissingExtra, UsageError, VlatoolError, nearest
from vlatool.files.writing import writing

app = typer.Typer(help="Random-weight policies of realistic shape.", no_args_is_help=True, rich_markup_mode=None)


@app.command("list")
def list_samples(
    as_json: Annotated[bool, typer.Option("--json", help="print JSON on stdout")] = False,
) -> None:
    """List the shapes that can be made."""
    if as_json:
        known = registry.names("samples")
        samples = [(name.replace("_", "-"), registry.module("samples", name).DESCRIPTION) for name in known]
        document([{"name": name, "description": text} for name, text in samples])
        return
    for name in registry.names("samples"):
        typer.echo(f"{name.replace('_', '-'):16} {registry.module('samples', name).DESCRIPTION}")


@app.command("make")
def make(
    name: Annotated[
        str,
        typer.Argument(
            help="which shape (see: vlatool samples list)", show_default=False, autocompletion=_complete.samples
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="directory of the new policy", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="seed of weights and data")] = 0,
    force: Annotated[bool, typer.Option("--force", help="replace an output that exists")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON on stdout")] = False,
) -> None:
    """Write a policy with seeded random weights, for latency and memory work."""
    from vlatool.boards.answer import carry_count
    from vlatool.samples import write_sample

    known = [entry.replace("_", "-") for entry in registry.names("samples")]
    if name.replace("_", "-") not in known:
        raise UsageError(f"Unknown sample '{name}'; {nearest(name, known)}.")
    refuse_existing(output, force, kind="")
    with writing(output, force=force) as draft:
        write_sample(name.replace("-", "_"), draft, seed)
    try:
        with progress() as context:
            carry_count(str(output), context)
    except MissingExtra:
        pass  # it is counted where torch is
    except (VlatoolError, OSError) as error:
        typer.echo(f"warning: it carries no count: {error}", err=True)
    if as_json:
        document({"policy": str(output), "sample": name.replace("_", "-"), "seed": seed})
        return
    typer.echo(f"{output}: {name}, seed {seed}")
