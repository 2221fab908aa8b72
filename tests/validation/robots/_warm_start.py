"""Start processes without the seconds that imports take: each is forked from one that has imported what they need.

    python tests/validation/robots/_warm_start.py MODULE...

A line on stdin is a list in JSON: a file for stderr, variables of the environment, then the command line as Python
takes it (``-m MODULE`` or a script, and arguments). The number of the new process comes on stdout. Those that are left
die with this one, which ends with stdin.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import runpy
import signal
import sys
import threading

KILL_ME_WITH_MY_PARENT = 1
"""``PR_SET_PDEATHSIG`` of Linux's ``prctl``."""


def become(errors: str, environment: dict[str, str], command: list[str]) -> None:
    """Turn this process, which has just been forked, into what a command line says."""
    ctypes.CDLL(None).prctl(KILL_ME_WITH_MY_PARENT, signal.SIGKILL)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    silence, _never_written = os.pipe()
    nowhere, file = os.open(os.devnull, os.O_WRONLY), os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for source, target in ((silence, 0), (nowhere, 1), (file, 2)):
        os.dup2(source, target)
    sys.stdin = os.fdopen(0)
    os.environ.update(environment)
    if command[0] == "-m":
        sys.argv = command[1:]
        runpy.run_module(command[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = command
        sys.path.insert(0, os.path.dirname(command[0]))
        runpy.run_path(command[0], run_name="__main__")


def main() -> None:
    for module in sys.argv[1:]:
        importlib.import_module(module)
    if threading.active_count() > 1:
        raise SystemExit(f"a module has started a thread, which a fork would lose: {threading.enumerate()}")
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that are killed
    for line in iter(sys.stdin.readline, ""):
        errors, environment, *command = json.loads(line)
        number = os.fork()
        if number == 0:
            become(errors, environment, command)
            sys.exit()
        print(number, flush=True)


if __name__ == "__main__":
    main()
