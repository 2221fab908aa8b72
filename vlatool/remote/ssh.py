"""A benchmark on another machine, through the user's own ``ssh``.

One connection does all of it. ``sh`` on the target finds a Python (``_probe``) and leaves no trace. That Python runs
``_bootstrap``, which makes a private directory, receives vlatool and the bundles, runs the agent, and removes all of it
when the run or the connection ends. The target needs Python 3.10, numpy and the engine, no more.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import vlatool
from vlatool.bundle.bundle import Bundle
from vlatool.errors import OutputError, TargetError, UsageError, VlatoolError
from vlatool.files.printable import one_line
from vlatool.measurement.child import SAID, message, raise_said, signal_name
from vlatool.remote import _probe, _push
from vlatool.remote._connection import AGAIN, Connection
from vlatool.remote._heard import facts_of, nonsense, number_of, parsed, sane, text_of
from vlatool.stage.base import Tell

AGENT = "vlatool.measurement.agent"
PACKAGE = Path(vlatool.__file__).parent
FURTHER: tuple[Path, ...] = ()
"""Single modules that are pushed beside the package."""
SHELL_S = 30
"""Seconds from a connection to an answer of ``sh``."""
PROBE_S = 120
"""Seconds for a Python to import numpy and an engine."""
PLACE_S = 60
LOG_CHARACTERS = 300
MOST_PYTHONS = 64


def measure_on(
    target: str,
    job: Mapping[str, Any],
    bundles: Sequence[Path],
    tell: Tell,
    *,
    python: str = "",
    ssh_options: Sequence[str] = (),
    connect_timeout_s: float = 15,
) -> dict[str, Any]:
    """Run a benchmark job on another machine and return its result; nothing is left there.

    Args:
        target: ``user@host`` or a Host of ``~/.ssh/config``, as ``ssh`` takes it.
        job: What the agent does, as JSON values; its ``bundles`` are replaced by those on the target.
        bundles: Bundle directories, in the order of the job.
        tell: Called with what is being done and the share that is done (0-1, or None when it is not known).
        python: Python to use on the target; ``~/`` is the home directory there. When empty, the first of python3 and
            python3.13 to python3.10 that is new enough and imports numpy and the engine.
        ssh_options: For ssh, before vlatool's own.
        connect_timeout_s: For ssh to connect.

    Returns:
        The agent's result, ``target``: python, architecture, kernel and packages there; no host, user or address; and
        ``log``: the end of what the processes wrote to standard error.

    Raises:
        TargetError: when the target cannot be reached or used, or what runs there ends without a result.
        MissingExtra: when this machine lacks ssh, or the target numpy or the engine.
        OutputError: when the target's disk is full or read-only.
        VlatoolError: what the agent raises, of the same class.
    """
    _check(target, python)
    opened = [Bundle.open(path, verify=False) for path in bundles]
    engine = str(job.get("engine") or "")
    packages = _probe.packages_of([engine] if engine else [bundle.manifest.engine for bundle in opened] or [""])
    load = _push.load_of(opened, PACKAGE, FURTHER)
    tell(f"connecting to {target}", None)
    connection = Connection(target, ssh_options, connect_timeout_s)
    connection.allow(float(job.get("duration") or 0))
    try:
        connection.send(_probe.script(connection.marker, python, packages))
        facts = _find_python(connection, target, python, packages, connect_timeout_s)
        tell(_about(target, facts), None)
        place = _send(connection, target, load, tell)
        connection.doing = "while it measured"
        there = {f"{place}/{name}": str(path) for name, path in zip(load.bundles, bundles, strict=True)}
        connection.tell({"module": AGENT, "job": {**job, "bundles": []}, "bundles": load.bundles})
        result = _follow(connection, target, there, tell)
    finally:
        connection.dispose()
    known = {name: facts[name] for name in ("architecture", "kernel", "packages")}
    return {**result, "target": {"python": ".".join(map(str, facts["version"])), **known}}


def _check(target: str, python: str) -> None:
    """Refuse what ssh would take for an option, or a shell for more than a name."""
    if not target or target.startswith("-") or any(each.isspace() or not each.isprintable() for each in target):
        raise UsageError(
            f"The target {target!r} is not a machine that ssh can reach.",
            "give user@host, or a Host of ~/.ssh/config",
        )
    if python.startswith("-") or not python.isprintable():
        raise UsageError(f"The remote Python {python!r} is not the path of a program.")


def _find_python(
    connection: Connection, target: str, python: str, packages: Sequence[str], connect_timeout_s: float
) -> dict[str, Any]:
    """Return the facts of the Python that runs on the target from now on."""
    connection.receive(connect_timeout_s + SHELL_S)
    connection.doing = "while it looked for a Python"
    told: list[dict[str, Any]] = []
    while True:
        told.append(heard := connection.receive(PROBE_S))
        if "none" in heard:
            raise _probe.refusal(target, python, told, packages)
        if len(told) > MOST_PYTHONS:
            raise nonsense(target, f"it has more than {MOST_PYTHONS} Pythons")
        facts = facts_of(heard, target)
        if facts:
            told[-1] = {"python": facts}
        elif "broken" in heard:
            told[-1] = {"broken": number_of(heard, "broken", target)}
        if facts and set(packages) == set(facts["packages"]):
            return facts


def _about(target: str, facts: Mapping[str, Any]) -> str:
    """Say what the target is."""
    packages = [f"{name} {version}" for name, version in facts["packages"].items()]
    room = [] if facts["free"] is None else [f"{facts['free'] / 1e9:.1f} GB free"]
    version = ".".join(map(str, facts["version"]))
    return f"{target}: " + ", ".join([f"Python {version}", facts["architecture"], *packages, *room])


def _send(connection: Connection, target: str, load: _push.Load, tell: Tell) -> str:
    """Send all files, and return the directory that they are in on the target."""
    connection.doing = "before the first file was sent"
    connection.tell({"need": load.room})
    answer = connection.receive(PLACE_S)
    if "ready" not in answer:
        raise _refused(target, answer)
    place = text_of(answer, "ready", target)
    sent = 0
    for packed, size in load.packed():
        connection.doing = f"while files were sent ({sent / 1e6:.1f} of {load.size / 1e6:.1f} MB)"
        tell(f"sending the bundles to {target}: {sent / 1e6:.1f} of {load.size / 1e6:.1f} MB", sent / load.size)
        if not connection.tell(_push.header(packed)) or not connection.send(packed):
            raise _refused(target, connection.receive())
        sent += size
    tell(f"sent {load.size / 1e6:.1f} MB to {target}", 1.0)
    return place


def _refused(target: str, answer: Mapping[str, Any]) -> VlatoolError:
    """Return the error for what the target could not do."""
    word, text = answer.get("refused", ""), one_line(str(answer.get("text", "")))
    if word == "no place":
        return OutputError(
            f"{target} has no directory to write to: {text}.", "set TMPDIR or XDG_CACHE_HOME there to one that has room"
        )
    if word == "no room":
        found = parsed(str(answer["text"]), target)
        need, free = (number_of(found, name, target) for name in ("need", "free"))
        numbers = f"{need / 1e6:.1f} MB are needed, {free / 1e6:.1f} MB are free"
        return OutputError(
            f"The disk of {target} is too full: {numbers} below {one_line(str(found.get('path')))}.",
            "free some space there",
        )
    if word == "full":
        return OutputError(f"The disk of {target} became full: {text}.", "free some space there")
    if word == "corrupt":
        return TargetError(f"What was sent to {target} did not arrive whole: {text}.", "run it again")
    return TargetError(f"{target} could not run the benchmark: {text or one_line(str(answer))}.", AGAIN)


def _follow(connection: Connection, target: str, there: Mapping[str, str], tell: Tell) -> dict[str, Any]:
    """Pass on what the agent tells until it has ended, and return its result."""
    answer: dict[str, Any] = {}
    while True:
        heard = connection.receive(alive=True)
        if "agent" in heard:
            said = _said(text_of(heard, "agent", target), there, target)
            if "progress" in said:
                _pass_on(said["progress"], tell)
            elif "result" in said or SAID in said:
                answer = said
        elif "ended" in heard or "refused" in heard:
            if heard.get("left"):
                tell(f"{target} could not remove {one_line(str(heard['left']))}", None)
            if "refused" in heard:
                raise _refused(target, heard)
            return _result(target, answer, sane(heard["ended"], target))


def _said(line: str, there: Mapping[str, str], target: str) -> dict[str, Any]:
    """Return a line of the agent, with the bundles under their local names; empty for anything else."""
    for remote, local in there.items():
        line = line.replace(json.dumps(remote)[1:-1], json.dumps(local)[1:-1])
    found: dict[str, Any] = sane(message(line), target)
    return found


def _pass_on(progress: Any, tell: Tell) -> None:
    match progress:
        case [str(what), (int() | float() | None) as share]:
            tell(one_line(what), share)


def _result(target: str, answer: Mapping[str, Any], ended: Mapping[str, Any]) -> dict[str, Any]:
    """Return the agent's result, or raise what it raised or why there is none."""
    raise_said(answer, otherwise=TargetError)
    if not isinstance(ended, Mapping):
        raise nonsense(target, "how it ended is no mapping")
    code, log = number_of(ended, "code", target), text_of(ended, "log", target)
    last = next((line.strip() for line in reversed(log.splitlines()) if line.strip()), "it logged nothing")
    last = last[-LOG_CHARACTERS:]
    if code == -signal.SIGKILL:
        raise TargetError(
            f"The benchmark on {target} was killed (SIGKILL), as it is when memory runs out; its last line: {last}",
            f"look for it with: ssh {target} dmesg; free memory there, or choose a smaller bundle",
        )
    if code < 0:
        raise TargetError(f"The benchmark on {target} was ended by {signal_name(code)}; its last line: {last}")
    if code or not isinstance(answer.get("result"), dict):
        raise TargetError(
            f"The benchmark on {target} ended with code {code} and without a result; its last line: {last}"
        )
    result = dict(answer["result"])
    return {**result, "log": f"{log}{result.get('log', '')}"}
