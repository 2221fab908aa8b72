"""A benchmark on another machine, through the user's own ``ssh``.

One connection does all of it. ``sh`` on the target finds a Python (``_probe``) and leaves no trace. That Python runs
``_bootstrap``, which makes a private directory, receives vlatool and the bundles, runs the agent, and removes all of it
when the run or the connection ends. The target needs Python 3.10, numpy and the engine, no more.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import vlatool
from vlatool.bundle.bundle import Bundle
from vlatool.errors import OutputError, TargetError, UsageError, VlatoolError
from vlatool.files.printable import one_line
from vlatool.machine.processes import signal_name
from vlatool.measurement.child import CRASHES, Progress, Raised, Result, error_of, read_line
from vlatool.remote import _probe, _push
from vlatool.remote._connection import RUN_AGAIN, Connection
from vlatool.remote._validate_replies import AgentExit, DiskFull, Python, invalid_reply, parse, python_of, read, sane
from vlatool.stage.base import OnProgress

AGENT = "vlatool.measurement.agent"
"""Module that runs a benchmark on the target."""
PACKAGE = Path(vlatool.__file__).parent
FURTHER_MODULES: tuple[Path, ...] = ()
"""Single modules that are pushed beside the package."""
SHELL_S = 30
"""Seconds from a connection to an answer of ``sh``."""
PROBE_S = 120
"""Seconds for a Python to import numpy and an engine."""
DIRECTORY_S = 60
LOG_CHARACTERS = 300
MAX_PYTHONS = 64


def measure_on(
    target: str,
    job: Mapping[str, Any],
    bundles: Sequence[Path],
    tell: OnProgress,
    *,
    python: str = "",
    ssh_options: Sequence[str] = (),
    connect_timeout_s: float = 15,
) -> dict[str, Any]:
    """Run a benchmark job on another machine and return its result; nothing is left there.

    Args:
        target: ``user@host`` or a Host of ``~/.ssh/config``, as ``ssh`` takes it.
        job: what the agent does, as JSON values; its ``bundles`` are replaced by those on the target.
        bundles: Bundle directories, in the order of the job.
        tell: function called with what is being done and the share that is done (0-1, or None when it is not known).
        python: Python to use on the target; ``~/`` is the home directory there. When empty, the first of python3 and
            python3.13 to python3.10 that is new enough and imports numpy and the engine.
        ssh_options: options of ssh, before vlatool's own.

    Returns:
        The agent's result, ``target``: python, architecture, kernel and packages there; no host, user or address; and
        ``log``: the end of what the processes wrote to standard error.

    Raises:
        TargetError: when the target cannot be reached or used, or what runs there ends without a result.
        MissingExtra: when this machine lacks ssh, or the target numpy or the engine.
        OutputError: when the target's disk is full or read-only.
        VlatoolError: what the agent raises, of the same class.
    """
    return run_on(Task(AGENT), target, job, bundles, tell, python=python, ssh_options=ssh_options,
                  connect_timeout_s=connect_timeout_s)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """What runs on the target.

    Args:
        module: module of vlatool, run as ``python -m``; it reads a job and answers as ``vlatool.measurement.child``.
        name: its name in messages.
        doing: when it runs, as the end of a sentence.
        packages: packages that it needs beside numpy and the engine of the bundles.
        files: path below the directory of the run -> file to send beside the bundles.
    """

    module: str
    name: str = "benchmark"
    doing: str = "while it measured"
    packages: tuple[str, ...] = ()
    files: Mapping[str, Path] = field(default_factory=dict)


def run_on(
    task: Task,
    target: str,
    job: Mapping[str, Any],
    bundles: Sequence[Path],
    tell: OnProgress,
    *,
    python: str = "",
    ssh_options: Sequence[str] = (),
    connect_timeout_s: float = 15,
) -> dict[str, Any]:
    """Run a task on another machine and return its result, as ``measure_on`` does."""
    _check(target, python)
    opened = [Bundle.open(path, verify=False) for path in bundles]
    engine = str(job.get("engine") or "")
    engines = [engine] if engine else [bundle.manifest.engine for bundle in opened] or [""]
    packages = (*_probe.packages_of(engines), *task.packages)
    load = _push.payload_of(opened, PACKAGE, FURTHER_MODULES, task.files)
    tell(f"connecting to {target}", None)
    connection = Connection(target, ssh_options, connect_timeout_s)
    connection.allow(float(job.get("duration") or 0))
    try:
        connection.send(_probe.script(connection.marker, python, packages))
        there = _find_python(connection, target, python, packages, connect_timeout_s)
        tell(_about(target, there), None)
        directory = _send(connection, target, load, tell)
        connection.doing = task.doing
        paths = {f"{directory}/{name}": str(path) for name, path in zip(load.bundles, bundles, strict=True)}
        connection.tell({"module": task.module, "job": {**job, "bundles": []}, "bundles": load.bundles})
        result = _follow(connection, target, task.name, paths, tell)
    finally:
        connection.dispose()
    known = {name: getattr(there, name) for name in ("architecture", "kernel", "packages")}
    return {**result, "target": {"python": _probe.version_text(there.version), **known}}


def _check(target: str, python: str) -> None:
    """Refuse what ssh would take for an option, or a shell for more than a name."""
    if not target or target.startswith("-") or any(letter.isspace() or not letter.isprintable() for letter in target):
        raise UsageError(
            f"The target {target!r} is not a machine that ssh can reach.", "give user@host, or a Host of ~/.ssh/config"
        )
    if python.startswith("-") or not python.isprintable():
        raise UsageError(
            f"The remote Python {python!r} is not the path of a program.",
            "name it as --remote-python ~/venv/bin/python",
        )


def _find_python(
    connection: Connection, target: str, python: str, packages: Sequence[str], connect_timeout_s: float
) -> Python:
    """Return the Python that runs on the target from now on."""
    connection.receive(connect_timeout_s + SHELL_S)
    connection.doing = "while it looked for a Python"
    pythons: list[Python] = []
    codes: list[int] = []
    for _ in range(MAX_PYTHONS):
        heard = connection.receive(PROBE_S)
        if "none" in heard:
            raise _probe.refusal(target, python, pythons, codes, packages)
        if "python" in heard:
            pythons.append(python_of(heard["python"], target))
            if set(packages) == set(pythons[-1].packages):
                return pythons[-1]
        elif "broken" in heard:
            codes.append(read(int, heard["broken"], target, "broken"))
    raise invalid_reply(target, f"it has more than {MAX_PYTHONS} Pythons")


def _about(target: str, python: Python) -> str:
    """Say what the target is."""
    packages = [f"{name} {version}" for name, version in python.packages.items()]
    room = [] if python.free is None else [f"{python.free / 1e9:.1f} GB free"]
    version = f"Python {_probe.version_text(python.version)}"
    return f"{target}: " + ", ".join([version, python.architecture, *packages, *room])


def _send(connection: Connection, target: str, load: _push.Payload, tell: OnProgress) -> str:
    """Send all files, and return the directory that they are in on the target."""
    connection.doing = "before the first file was sent"
    connection.tell({"need": load.room})
    answer = connection.receive(DIRECTORY_S)
    if "ready" not in answer:
        raise _target_error(target, answer)
    directory = read(str, answer["ready"], target, "ready")
    sent = 0
    for packed, size in load.archives():
        connection.doing = f"while files were sent ({sent / 1e6:.1f} of {load.size / 1e6:.1f} MB)"
        tell(f"sending the bundles to {target}: {sent / 1e6:.1f} of {load.size / 1e6:.1f} MB", sent / load.size)
        if not connection.tell(_push.header(packed)) or not connection.send(packed):
            raise _target_error(target, connection.receive())
        sent += size
    tell(f"sent {load.size / 1e6:.1f} MB to {target}", 1.0)
    return directory


def _target_error(target: str, answer: Mapping[str, Any]) -> VlatoolError:
    """Return the error for what the target could not do."""
    word, text = answer.get("refused", ""), one_line(str(answer.get("text", "")))
    if word == "no place":
        return OutputError(
            f"{target} has no directory to write to: {text}.", "set TMPDIR or XDG_CACHE_HOME there to one that has room"
        )
    if word == "no room":
        disk = read(DiskFull, parse(str(answer["text"]), target), target, "room")
        numbers = f"{disk.need / 1e6:.1f} MB are needed, {disk.free / 1e6:.1f} MB are free"
        return OutputError(
            f"The disk of {target} is too full: {numbers} below {one_line(disk.path)}.", "free some space there"
        )
    if word == "full":
        return OutputError(f"The disk of {target} became full: {text}.", "free some space there")
    if word == "corrupt":
        return TargetError(f"What was sent to {target} did not arrive whole: {text}.", "run it again")
    return TargetError(f"{target} could not run what was sent: {text or one_line(str(answer))}.", RUN_AGAIN)


def _follow(
    connection: Connection, target: str, name: str, paths: Mapping[str, str], tell: OnProgress
) -> dict[str, Any]:
    """Pass on what the agent tells until it has ended, and return its result."""
    answer: Result | Raised | None = None
    while True:
        heard = connection.receive(alive=True)
        if "agent" in heard:
            line = read(str, heard["agent"], target, "agent")
            for there, here in paths.items():
                line = line.replace(json.dumps(there)[1:-1], json.dumps(here)[1:-1])
            match read_line(line, lambda values: sane(values, target)):
                case Progress(what, share):
                    tell(one_line(what), share)
                case (Result() | Raised()) as last:
                    answer = last
        elif "ended" in heard or "refused" in heard:
            if heard.get("left"):
                tell(f"{target} could not remove {one_line(str(heard['left']))}", None)
            if "refused" in heard:
                raise _target_error(target, heard)
            return _result(target, name, answer, read(AgentExit, heard["ended"], target, "ended"))


def _result(target: str, name: str, answer: Result | Raised | None, ended: AgentExit) -> dict[str, Any]:
    """Return the agent's result, or raise what it raised or why there is none."""
    if isinstance(answer, Raised):
        raise error_of(answer, otherwise=TargetError)
    code, log = ended.code, ended.log
    last = next((line.strip() for line in reversed(log.splitlines()) if line.strip()), "it logged nothing")
    last = last[-LOG_CHARACTERS:]
    if code == -signal.SIGKILL:
        raise TargetError(
            f"The {name} on {target} was killed (SIGKILL), as it is when memory runs out; its last line: {last}",
            f"look for it with: ssh {target} dmesg; free memory there, or choose a smaller bundle",
        )
    if code < 0:
        raise TargetError(f"The {name} on {target} was ended by {signal_name(code)}; its last line: {last}", CRASHES)
    if code or answer is None or not isinstance(answer.value, dict):
        raise TargetError(
            f"The {name} on {target} ended with code {code} and without a result; its last line: {last}",
            f"run the {name} on the target itself to see more",
        )
    return {**answer.value, "log": f"{log}{answer.value.get('log', '')}"}
