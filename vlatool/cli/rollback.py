"""``vlatool rollback``."""

from __future__ import annotations

from vlatool.cli._console import progress
from vlatool.cli._deployment import StoreFolder, Target, TargetPython, lines, perform_on
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson


def rollback(
    target: Target = None, store: StoreFolder = "", remote_python: TargetPython = "", as_json: AsJson = False
) -> None:
    """Go back to the bundle before the active one; a robot that watches its store exchanges them while it runs."""
    with progress() as context:
        found = perform_on(target, "rollback", store, context.progress, python=remote_python)
    answer(as_json, found, lines(found))
