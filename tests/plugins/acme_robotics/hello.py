"""A command."""

import typer


def acme(name: str) -> None:
    """Say hello."""
    typer.echo(f"hello {name}")
