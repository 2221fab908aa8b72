"""``vlatool doctor``."""

from __future__ import annotations

from dataclasses import asdict

import typer

from vlatool.cli._document import document
from vlatool.cli._options import AsJson


def doctor(as_json: AsJson = False) -> None:
    """Show what this machine has: engines, instruction sets, telemetry, clocks, missing extras; and how to fix it."""
    from vlatool.doctor.doctor import diagnose

    checks = diagnose()
    if as_json:
        document([asdict(check) for check in checks])
        return
    marks = {"ok": "ok     ", "warn": "warn   ", "missing": "missing"}
    for check in checks:
        typer.echo(f"{marks[check.status]} {check.name}: {check.finding}")
        if check.fix and check.status != "ok":
            typer.echo(f"          fix: {check.fix}")
