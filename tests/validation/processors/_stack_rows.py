"""The rows of ``arm64.py`` about what is around a policy: the same files on an emulated board and on this host."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _asked import CRASHED, ROOT
from _emulation import Emulators
from _stack_serving import serving_rows
from _verdicts import Difference, Row

from vlatool.deployment.deploy import Conditions
from vlatool.remote.deployment import change_on

SCRIPT = Path(__file__).with_name("robot_stack.py")
EXACT, ROUNDED, PROMISE = 0.0, 1e-6, 1e-9
"""Largest differences: of counts, of actions in float32, and of what an envelope sends, also from its limits."""
KINDS = {"actions": ("actions: {} controllers, modes", ROUNDED), "commands": ("envelopes: {} robots, modes", PROMISE),
         "excess": ("excess over the limits", PROMISE), "deadline": ("graphs without end, stopped", EXACT),
         "updates": ("deploy, trial, rollback", EXACT)}  # fmt: skip
"""First word of an array -> its row, and the largest difference from this host."""
WANTED = {"deadline": np.array([3, 3]), "updates": np.array([1.0, 1, 1, 0, 2, 2, 2, 0, 0, 0, 1])}
"""What ``robot_stack.py`` counts everywhere: loops stopped and right answers after them; the bundle that answers each
tick of two trials, each trial's end, two bundles that are refused, and the one before the rollback."""
VERSIONS = ["1.0.0", "2.0.0", "2.0.0", "1.0.0"]
"""Active after each of the actions through ssh: deploy, deploy, status, rollback."""


def stack_rows(
    board: tuple[str, str], python: Sequence[str], path: dict[str, str], cache: Emulators, parts: str
) -> list[Row]:
    """Return a row for each kind of layer; only for controllers when ``parts`` says so."""
    folder, where = cache.folder / "answers" / "stack", (*board, "the stack")
    options: list[Any] = ["--steps", "0"]
    if parts == "all":
        from _stack_bundles import make_all

        options = ["--steps", "1000", "--bundles", make_all(cache.folder / "bundles" / "stack")]
    found = []
    emulated = board_python(folder / "python", python, path)
    for word, name in ((sys.executable, "here"), (str(emulated), "there")):
        file = folder / f"{name}.npz"
        place = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run([word, SCRIPT, "-o", file, *options], env=place, check=False, cwd=ROOT)
        if done.returncode:
            return [Row(where, "layers", None, EXACT, CRASHED, note=f"{name}: left with {done.returncode}")]
        with np.load(file) as arrays:
            found.append({key: arrays[key] for key in arrays.files})
    rows = compared_stacks(where, *found)
    if parts != "all":
        return rows
    stored = cache.folder / "bundles" / "stack"
    packages = {"PYTHONPATH": f"{ROOT}:{cache.serving()}:{path['PYTHONPATH']}"}
    serves = board_python(folder / "serves", python, packages)
    return [*rows, through_ssh(where, emulated, stored), *serving_rows(where, serves, stored / "arm")]


def compared_stacks(where: tuple[str, ...], here: dict[str, Any], there: dict[str, Any]) -> list[Row]:
    """Return a row for each kind of array: the largest difference of its elements from this host's, or from counts."""
    rows, here = [], here | {kind: counts for kind, counts in WANTED.items() if kind in here}
    for kind, (title, limit) in KINDS.items():
        names = [name for name in here if name.split()[0] == kind]
        if not names:
            continue
        apart = max(_apart(here[name], there.get(name)) for name in names)
        if kind == "excess" and kind in there:
            apart = max(apart, float(there[kind].max()))
        rows.append(Row(where, title.format(len(names)), Difference(apart, apart), limit))
    return rows


def _apart(here: Any, there: Any) -> float:
    if there is None or there.shape != here.shape or not np.isfinite(there).all():
        return float("inf")
    return float(np.abs(here - there).max(initial=0.0))


def board_python(file: Path, python: Sequence[str], path: dict[str, str]) -> Path:
    """Write a script that is the board's Python, also for its child processes: Python takes it for itself."""
    emulator, *words = python
    variables = " ".join(f"{name}='{value}'" for name, value in path.items())
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"#!/bin/sh\n{variables} exec '{emulator}' -0 '{file}' {' '.join(words)} \"$@\"\n")
    file.chmod(0o755)
    return file


def through_ssh(where: tuple[str, ...], board: Path, bundles: Path) -> Row:
    """Return the row of a deployment to the board through a real ssh, with a server on this host.

    Args:
        board: Python that the sessions use.
        bundles: Folder of the two bundles.
    """
    title = "deploy, status, rollback by ssh"
    missing = [name for name in ("pytest", "psutil", "asyncssh") if importlib.util.find_spec(name) is None]
    if missing:
        return Row(where, title, None, EXACT, skipped=f"needs {', '.join(missing)}")
    sys.path.insert(0, str(ROOT / "tests/remote"))
    from _ssh_server import serving, target

    seen = []
    conditions = Conditions(runs=2, latency_ms=0, memory_mb=0, first_run_s=600, seconds=0, ticks=0)
    with tempfile.TemporaryDirectory() as name, serving(Path(name)) as server:
        server.session("")
        for action in (*(["deploy", each] for each in ("one", "two")), ["status"], ["rollback"]):
            bundle = bundles / action[1] if action[1:] else None
            found = change_on(
                target(), action[0], str(Path(name, "store")), lambda *_: None, bundle=bundle,
                conditions=conditions if bundle else None, python=str(board), ssh_options=server.options(),
            )  # fmt: skip
            seen.append(found["slots"][found["active"]]["version"])
    wrong = float(sum(one != other for one, other in zip(seen, VERSIONS, strict=True)))
    return Row(where, title, Difference(wrong, wrong), EXACT, note=", ".join(seen))
