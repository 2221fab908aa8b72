"""Bundles asked on a processor, real or emulated, in a process that may crash."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCRIPT = Path(__file__).with_name("answers.py")
ROOT = SCRIPT.parents[3]
CRASHED = "crash"
SECONDS = 7200.0
"""How long one process may take: emulated float32 products take seconds each."""


@dataclass(frozen=True)
class Answer:
    """What a bundle answered.

    Args:
        actions: (N, ...) raw actions, one row an observation; None where it cannot be made to run.
        refused: Type of the error with which ``load`` refuses it, ``CRASHED`` when the process ended; else empty.
        why: Its message.
        golden: Relative L2 difference of the golden action; NaN when unknown.
        arithmetic: How the engine computes int8 products there, in its own words.
        engine: Engine and version.
        seconds: How long it took.
    """

    actions: NDArray[Any] | None
    refused: str = ""
    why: str = ""
    golden: float = float("nan")
    arithmetic: str = ""
    engine: str = ""
    seconds: float = float("nan")


def ask(
    python: Sequence[str],
    bundles: Mapping[str, Path],
    observations: Path,
    out: Path,
    engine: str = "",
    variables: Mapping[str, str] | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, Answer]:
    """Ask every bundle, in one process as long as that lives.

    Args:
        python: The words that start Python there.
        bundles: Name -> bundle.
        observations: A file that numpy alone reads.
        out: A folder for the answers.
        engine: Name of the engine; the bundle's own when empty.
        variables: Further variables of the environment.
        tell: Takes a line about each bundle.

    Returns:
        Name -> answer, of every bundle.
    """
    names = {path.name: name for name, path in bundles.items()}
    answers: dict[str, Answer] = {}
    while left := [path for name, path in bundles.items() if name not in answers]:
        words = [*python, str(SCRIPT), "--observations", str(observations), "-o", str(out)]
        words += [*(["--engine", engine] if engine else []), *map(str, left)]
        lines, ended = run(words, variables or {})
        for line in lines:
            answers[names[line["bundle"]]] = answer = read(line, out)
            tell(f"  {names[line['bundle']]}: {answer.refused or 'loads'}, {answer.seconds:.0f} s")
        if len(lines) < len(left):
            answers[names[left[len(lines)].name]] = Answer(None, CRASHED, ended)
            tell(f"  {names[left[len(lines)].name]}: {ended}")
    return answers


def run(words: Sequence[str], variables: Mapping[str, str]) -> tuple[list[dict[str, Any]], str]:
    """Run the script and return its lines and, where it failed, how it ended.

    Raises:
        KeyboardInterrupt: when it was interrupted, as all processes of a terminal are.
    """
    place = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **variables}
    try:
        done = subprocess.run(words, cwd=ROOT, env=place, capture_output=True, text=True, check=False, timeout=SECONDS)
    except subprocess.TimeoutExpired as late:
        printed = late.stdout or b""
        text = printed if isinstance(printed, str) else printed.decode(errors="replace")
        return parsed(text), f"it took more than {SECONDS:g} s"
    if done.returncode == -signal.SIGINT:
        raise KeyboardInterrupt
    return parsed(done.stdout), how_it_ended(done.returncode, done.stderr)


def parsed(text: str) -> list[dict[str, Any]]:
    """Return the lines of JSON, without one that a process did not write to its end."""
    return [json.loads(line) for line in text.splitlines() if line.startswith("{") and line.endswith("}")]


def how_it_ended(code: int, stderr: str) -> str:
    """Say how a process ended that should have gone on."""
    signs = [line.strip() for line in stderr.splitlines() if line.strip()]
    uncaught = next((line for line in signs if re.search(r"uncaught target signal \d+", line)), "")
    if uncaught or code < 0:
        return f"the process was killed: {uncaught or signal.Signals(-code).name}"
    return f"the process left with {code}: {signs[-1][:200] if signs else 'it said nothing'}"


def read(line: Mapping[str, Any], out: Path) -> Answer:
    """Return an answer as the script wrote it."""
    actions = np.load(out / line["file"], allow_pickle=False) if line["file"] else None
    golden = line.get("golden")
    return Answer(
        actions,
        line["refused"],
        line["why"],
        float("nan") if golden is None else float(golden),
        line.get("arithmetic", ""),
        line.get("engine", ""),
        float(line["seconds"]),
    )
