"""An interpreter that stays, and runs command lines one after the other.

A fresh interpreter imports for one to four seconds before it does what a test is about, and so does the server of its
children. Tests of what begins or ends with the process start one of their own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

RUNS = """
import json, os, sys, traceback
answers = os.fdopen(int(sys.argv[1]), "w")
kept = os.dup(1), os.dup(2)
for line in os.fdopen(int(sys.argv[2])):
    asked = json.loads(line)
    for number in (1, 2):
        os.dup2(os.open(asked["told"][number - 1], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    before = dict(os.environ)
    os.environ.update(asked["environment"])
    code = 0
    try:
        if "code" in asked:
            exec(asked["code"], {"__name__": "__main__"})
        else:
            from vlatool.cli import main
            main(asked["words"])
    except SystemExit as left:
        code = left.code or 0
    except BaseException:
        traceback.print_exc()
        code = 1
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    for number in (1, 2):
        os.dup2(kept[number - 1], number)
    os.environ.clear()
    os.environ.update(before)
    print(code, file=answers, flush=True)
"""


class Console:
    """Runs command lines in a child of its own.

    Args:
        place: Where it works, and keeps what the commands print.
        python: The interpreter.
        environment: All variables that it has; those of this process when None.
    """

    def __init__(
        self, place: Path, python: Path | str = sys.executable, environment: Mapping[str, str] | None = None
    ) -> None:
        self._told = (place / "console.out", place / "console.err")
        self._process = subprocess.Popen(
            ["sh", "-c", 'exec "$@" 3>&1 4<&0 >/dev/null </dev/null', "sh", str(python), "-W", "ignore", "-c", RUNS,
             "3", "4"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=place, env=environment,
        )  # fmt: skip

    def __enter__(self) -> Console:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate(timeout=60)

    def run(self, *words: str, code: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
        """Run one command line of vlatool, or Python code, and return what became of it.

        Args:
            words: The command line.
            code: Python code to run instead.
            environment: Variables that it has beside those of the console.
        """
        asked = {"words": words, "told": list(map(str, self._told)), "environment": environment}
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({**asked, **({"code": code} if code else {})}) + "\n")
        self._process.stdin.flush()
        status = self._process.stdout.readline()
        told = [path.read_text() for path in self._told]
        assert status, f"the console has ended: {told}"
        return subprocess.CompletedProcess(words, int(status), *told)
