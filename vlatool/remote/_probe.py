"""Find a Python on the target that can measure, through ``sh``, without leaving files there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

from vlatool.errors import MissingExtra, TargetError, VlatoolError
from vlatool.remote._validate_replies import Python
from vlatool.runtime.engine import engine_class

OLDEST = (3, 10)
CANDIDATES = ("python3", "python3.13", "python3.12", "python3.11", "python3.10")
INCOMPLETE = 9

SCRIPT = """\
{
say() { printf '\\n%s%s\\n' @marker "$1"; }
say '{"shell": true}'
found=
for one in @candidates; do
  command -v "$one" >/dev/null 2>&1 || continue
  "$one" -B -c @question @marker "$one" @packages </dev/null 2>/dev/null
  code=$?
  if [ $code = 0 ]; then found=$one; break; fi
  if [ $code != @incomplete ]; then say "{\\"broken\\": $code}"; fi
done
if [ -z "$found" ]; then say '{"none": true}'; exit 0; fi
exec "$found" -I -B -c @program @marker
}
"""
"""For ``sh`` on its standard input: one compound command, so that nothing after it is read before it runs."""

QUESTION = """\
import sys
sys.path[:] = [place for place in sys.path if place]
import json, os, platform
marker, command, packages = sys.argv[1], sys.argv[2], sys.argv[3:]
facts = {"command": command, "version": list(sys.version_info[:3]), "packages": {}, "errors": {}}
facts["architecture"], facts["kernel"] = platform.machine(), platform.release()
good = sys.version_info >= (3, 10)
if good:
    import sysconfig
    for name in packages:
        try:
            facts["packages"][name] = str(__import__(name).__version__)
        except Exception as error:
            facts["errors"][name] = (str(error).strip().splitlines() or [type(error).__name__])[-1]
    managed = os.path.join(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    facts["managed"] = sys.prefix == sys.base_prefix and os.path.exists(managed)
    good = not facts["errors"]
place = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
while not os.path.isdir(place) and place != os.path.dirname(place):
    place = os.path.dirname(place)
try:
    free = os.statvfs(place)
    facts["free"] = free.f_bavail * free.f_frsize
except OSError:
    facts["free"] = None
sys.stdout.write("\\n" + marker + json.dumps({"python": facts}) + "\\n")
sys.stdout.flush()
sys.exit(0 if good else 9)
"""
"""For any Python, from 2.7 on: who are you, and can you import these packages? Writes no file, not even bytecode."""


def packages_of(engines: Iterable[str]) -> tuple[str, ...]:
    """Return numpy and the packages of the engines."""
    return ("numpy", *sorted({engine_class(name).package for name in engines}))


def script(marker: str, python: str, packages: Sequence[str]) -> bytes:
    """Return what ``sh`` on the target runs: it finds a Python, which then runs ``_bootstrap``."""
    values = {
        "marker": shlex.quote(marker),
        "candidates": " ".join(map(_word, [python] if python else CANDIDATES)),
        "question": shlex.quote(QUESTION),
        "packages": " ".join(map(shlex.quote, packages)),
        "incomplete": str(INCOMPLETE),
        "program": shlex.quote(program()),
    }
    return re.sub("@(" + "|".join(values) + r")\b", lambda name: values[name[1]], SCRIPT).encode()


def program() -> str:
    """Return the text of ``_run_directory`` and ``_bootstrap`` as one program that imports nothing of vlatool."""
    lines = ["from __future__ import annotations"]
    for name in ("_run_directory.py", "_bootstrap.py"):
        lines += (Path(__file__).with_name(name)).read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines[1:] if not line.startswith(("from __future__ ", "from vlatool"))]
    return "\n".join([lines[0], *kept]) + "\n"


def _word(python: str) -> str:
    """Quote the name of a Python for ``sh``; a leading ``~/`` is the home directory of the target."""
    return '"$HOME"/' + shlex.quote(python[2:]) if python.startswith("~/") else shlex.quote(python)


def version_text(version: Iterable[int]) -> str:
    """Return ``3.11.2``."""
    return ".".join(map(str, version))


def refusal(
    target: str, python: str, pythons: Sequence[Python], codes: Sequence[int], packages: Sequence[str]
) -> VlatoolError:
    """Return the error for a target none of whose Pythons can measure.

    Args:
        target: target, as ``ssh`` takes it.
        python: the one that the user named, or empty.
        pythons: Pythons that answered.
        codes: exit codes of those that failed.
        packages: what must be importable.
    """
    new = [other for other in pythons if other.version[:2] >= OLDEST]
    if new:
        return _lacking(target, min(new, key=lambda other: len(other.errors)))
    fix = f"install Python {version_text(OLDEST)} or later there, or name one: --remote-python /path/to/venv/bin/python"
    if pythons:
        versions = ", ".join(f"{other.command} is {version_text(other.version)}" for other in pythons)
        oldest = version_text(OLDEST)
        return TargetError(f"The Python of {target} is too old: {versions}; {oldest} or later is needed.", fix)
    if codes:
        which = python or "python3"
        names = " and ".join(packages)
        return TargetError(
            f"{which} on {target} ended with code {codes[0]} when it was to import {names}.",
            f"see what it says: ssh {target} \"{which} -c 'import {', '.join(packages)}'\"",
        )
    named = f"{python}: no such program" if python else f"none of {', '.join(CANDIDATES)} is found"
    return TargetError(f"{target} has no Python to measure with ({named}).", fix)


def _lacking(target: str, python: Python) -> MissingExtra:
    command, errors = python.command, python.errors
    reasons = "; ".join(f"{name}: {reason}" for name, reason in errors.items())
    lacking = " ".join(errors)
    fix = f"ssh {target} {command} -m pip install {lacking}"
    if python.managed:
        venv = "vlatool-venv/bin/python"
        fix = (
            f"ssh {target} '{command} -m venv --system-site-packages vlatool-venv && {venv} -m pip install {lacking}', "
        )
        fix += f"then --remote-python '~/{venv}'"
    else:
        fix += "; or name a Python that has them: --remote-python /path/to/venv/bin/python"
    version = version_text(python.version)
    return MissingExtra(
        f"{command} on {target} (Python {version}) cannot import {' and '.join(errors)}: {reasons}.", fix
    )
