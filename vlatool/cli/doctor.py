"""``vlatool doctor``."""

from __future__ import annotations

from dataclasses import asdict

from vlatool.cli._document import answer
from vlatool.cli._options import AsJson


def doctor(as_json: AsJson = False) -> None:
    """Show what this machine has: engines, instruction sets, telemetry, clocks, missing extras; and how to fix it."""
    from vlatool.doctor.doctor import diagnose

    checks = diagnose()
    lines = []
    for check in checks:
        lines.append(f"{check.status:7} {check.name}: {check.finding}")
        lines += [f"          fix: {check.fix}"] if check.fix and check.status != "ok" else []
    answer(as_json, [asdict(check) for check in checks], lines)
