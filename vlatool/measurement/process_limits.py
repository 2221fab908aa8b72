"""Run a module of vlatool under limits: ``python -m vlatool.measurement.process_limits LIMITS MODULE ARGUMENTS...``.

The limits are set before anything is imported that could take memory or start threads.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import runpy
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from vlatool.errors import UsageError
from vlatool.files.messages import from_json, to_json
from vlatool.machine.processes import die_with_parent, python_command
from vlatool.measurement.jobs import Limits

GROUPS = (
    (Path("/sys/fs/cgroup"), "memory.max", ("memory.swap.max", "0")),
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", ("memory.memsw.limit_in_bytes", "")),
)
"""Where groups are made in v2 and v1: directory, file of the limit, file against swapping and what it gets (the limit
itself when empty)."""


def command(limits: Limits, module: str, arguments: Sequence[str] = ()) -> list[str]:
    """Return the command of a module, under the limits where there are any."""
    if not limits:
        return python_command(module, arguments)
    return python_command("vlatool.measurement.process_limits", (json.dumps(to_json(limits)), module, *arguments))


@contextlib.contextmanager
def control_group(limits: Limits) -> Iterator[Limits]:
    """Yield the limits with a control group for the memory where this user may make one, and remove it in the end.

    Memory that a control group limits is what the kernel counts as resident, as on the board. Elsewhere each process
    limits its private writable memory (``RLIMIT_DATA``), which counts what is reserved and not touched, too.
    """
    _remove_stale_groups()
    group = _new_group(limits) if limits.memory_mb else None
    try:
        yield limits if group is None else replace(limits, cgroup=str(group))
    finally:
        if group is not None:
            _remove(group)


def _remove_stale_groups() -> None:
    """Remove the groups of runs that were killed."""
    for base, *_ in GROUPS:
        for left in base.glob("vlatool-*-*"):
            number = left.name.split("-")[1]
            if number.isdigit() and not Path("/proc", number).exists():
                _remove(left, 0.0)


def _remove(group: Path, patience_s: float = 1.0) -> None:
    """Remove a group once its last process has been reaped."""
    end = time.monotonic() + patience_s
    while True:
        try:
            group.rmdir()
        except FileNotFoundError:
            return
        except OSError:
            if time.monotonic() >= end:
                return
            time.sleep(0.02)
        else:
            return


def ran_out(limits: Limits) -> bool:
    """Say whether a control group has ended a process for its memory."""
    if not limits.cgroup:
        return False
    for name in ("memory.events", "memory.oom_control"):
        with contextlib.suppress(OSError):
            text = (Path(limits.cgroup) / name).read_text(encoding="ascii")
            counted = dict(line.split() for line in text.splitlines() if len(line.split()) == 2)
            if "oom_kill" in counted:
                return int(counted["oom_kill"]) > 0
    return False


def _new_group(limits: Limits) -> Path | None:
    size = str(int(limits.memory_mb * 1e6))
    for base, name, (swap, value) in GROUPS:
        group = None
        try:
            group = Path(tempfile.mkdtemp(prefix=f"vlatool-{os.getpid()}-", dir=base))
            if not (group / name).exists():  # no group, but a plain directory: nothing is mounted there
                raise FileNotFoundError(group / name)
            (group / name).write_text(size, encoding="ascii")
        except OSError:
            if group is not None:
                _remove(group, 0.0)
            continue
        with contextlib.suppress(OSError):  # a kernel without swap accounting has no such file
            (group / swap).write_text(value or size, encoding="ascii")
        return group
    return None


def choose_processors(limits: Limits) -> Limits:
    """Return the limits with the processors named: those that are asked for, the first ones of them where fewer.

    Raises:
        UsageError: when one that is asked for is not there.
    """
    usable = sorted(os.sched_getaffinity(0))
    if missing := [cpu for cpu in limits.cpus if cpu not in usable]:
        allowed = ", ".join(map(str, usable))
        raise UsageError(
            f"--pin names processor {missing[0]}; this process may use {allowed}.",
            f"name some of these with --pin: {allowed}",
        )
    if not (limits.cpus or limits.cores):
        return limits
    cpus = limits.cpus or tuple(usable)
    return replace(limits, cpus=cpus[: limits.cores or len(cpus)])


def limit_this_process(limits: Limits) -> None:
    """Take the limits upon this process and all that it starts; raises OSError when a processor is not there."""
    if limits.cpus:
        os.sched_setaffinity(0, limits.cpus)
    if limits.cgroup:
        (Path(limits.cgroup) / "cgroup.procs").write_text(str(os.getpid()), encoding="ascii")
    elif limits.memory_mb:
        size = int(limits.memory_mb * 1e6)
        resource.setrlimit(resource.RLIMIT_DATA, (size, size))


def main() -> None:
    """Set the limits and become the module."""
    die_with_parent()
    limit_this_process(from_json(Limits, json.loads(sys.argv[1])))
    module = sys.argv[2]
    sys.argv = [module, *sys.argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
