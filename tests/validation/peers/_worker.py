"""One contestant in a process of its own: opens its model, then answers one line of JSON for each line of JSON.

    {"block": 3, "start": 5}  ->  {"wall": [ms, ms, ms], "cpu": [ms, ms, ms]}   one more inference before is not timed
    {"outputs": "file.npy"}   ->  {"peak": MB}    the action of every evaluation sample

Usage: python tests/validation/peers/_worker.py --folder DIR --workload NAME [--build] [--core N] CONTESTANT
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import time
import traceback
from pathlib import Path
from typing import Any, TextIO

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from _limits import LIMITS, open_limit  # noqa: E402
from _ours import MARK, open_bundle  # noqa: E402
from _peers import PEERS  # noqa: E402
from _workload import Feeds, Infer, Workload  # noqa: E402


def main() -> int:
    """Build, or open and serve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("contestant", help=f"a peer's name, or {MARK}BUNDLE")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--workload", required=True)
    parser.add_argument("--build", action="store_true", help="make the peer's model file and stop")
    parser.add_argument("--core", type=int, default=None, help="the one core to run on")
    given = parser.parse_args()
    workload = Workload(given.workload, given.folder)
    if given.build:
        PEERS[given.contestant].prepare(workload)
        return 0
    with private_stdout() as answers:
        serve(workload, given.contestant, given.core, answers)
    return 0


def private_stdout() -> TextIO:
    """Return the pipe to the driver; what libraries print goes to stderr instead."""
    kept = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    return kept


def pin(core: int | None) -> None:
    """Move every thread of this process to one core; opening a model before may use all of them."""
    for thread in os.listdir("/proc/self/task") if core is not None else ():
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(int(thread), {int(core or 0)})


def serve(workload: Workload, contestant: str, core: int | None, answers: TextIO) -> None:
    """Answer requests until stdin ends; the first answer says that the model is open, or why it is not."""

    def answer(content: dict[str, Any]) -> None:
        answers.write(json.dumps(content) + "\n")

    start = time.perf_counter()
    try:
        infer, rows = opened(workload, contestant)
        infer(rows[0])
        infer(rows[1])
        pin(core)
    except Exception as error:  # whatever a library raises becomes a row of the table
        traceback.print_exc()
        answer({"error": f"{type(error).__name__}: {(str(error).strip() or 'no message').splitlines()[-1][:300]}"})
        return
    answer({"load": time.perf_counter() - start})
    for line in sys.stdin:
        request = json.loads(line)
        if "block" in request:
            answer(timed(infer, rows, request["start"], request["block"]))
        else:
            save_outputs(infer, rows, Path(request["outputs"]))
            answer({"peak": peak_mb()})


def opened(workload: Workload, contestant: str) -> tuple[Infer, list[Feeds]]:
    """Return one inference and its inputs."""
    if contestant in LIMITS:
        return open_limit(contestant), [{}] * 12
    if contestant.startswith(MARK):
        return open_bundle(workload, Path(contestant.removeprefix(MARK)))
    peer = PEERS[contestant]
    return peer.open(workload, peer.model(workload)), workload.feeds("evaluation")


def timed(infer: Infer, rows: list[Feeds], start: int, count: int) -> dict[str, list[float]]:
    """Time ``count`` inferences, after one that fills the caches which the other contestants emptied."""
    infer(rows[(start - 1) % len(rows)])
    wall, cpu = [], []
    for index in range(start, start + count):
        row = rows[index % len(rows)]
        began, began_cpu = time.perf_counter_ns(), time.process_time_ns()
        infer(row)
        wall.append((time.perf_counter_ns() - began) / 1e6)
        cpu.append((time.process_time_ns() - began_cpu) / 1e6)
    return {"wall": wall, "cpu": cpu}


def save_outputs(infer: Infer, rows: list[Feeds], file: Path) -> None:
    import numpy as np

    with file.open("wb") as stream:
        np.save(stream, np.stack([np.asarray(infer(row), np.float32) for row in rows]))


def peak_mb() -> float:
    """Return the largest resident set of this process in MB (10^6 bytes)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024 / 1e6


if __name__ == "__main__":
    sys.exit(main())
