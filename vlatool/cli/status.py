"""``vlatool status``."""

from __future__ import annotations

from vlatool.cli._console import progress
from vlatool.cli._deployment import StoreFolder, Target, TargetPython, lines, perform_on
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson
from vlatool.errors import BundleError


def status(
    target: Target = None, store: StoreFolder = "", remote_python: TargetPython = "", as_json: AsJson = False
) -> None:
    """Show what is deployed, here or on a robot, and verify every file of it."""
    with progress() as context:
        found = perform_on(target, "status", store, context.progress, python=remote_python)
    answer(as_json, found, lines(found))
    if problem := found["slots"][found["active"]]["problem"]:
        raise BundleError(f"The active bundle is damaged: {problem}", "vlatool rollback; or deploy a whole one")
