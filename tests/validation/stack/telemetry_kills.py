"""kill -9 while a stack acts: lines of telemetry and the recorded run are readable, up to a second before the end.

    python tests/validation/stack/telemetry_kills.py --kills 200

A child acts at 100 Hz, writes lines of JSON and records its run; it is killed at a random time. Both files have to be
readable, without a gap, and the recording has to be replayed bit by bit.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from overhead import ROBOT, small_bundle

from vlatool.runtime.replay import replay
from vlatool.runtime.telemetry.json_lines import read_lines
from vlatool.runtime.telemetry.run_file import FrameKind, read_run

CHILD = """
import sys, time
import numpy as np
from vlatool.runtime import load
from vlatool.runtime.stack import Fallback
from vlatool.runtime.telemetry import Telemetry
from vlatool.runtime.telemetry.json_lines import JsonLines
bundle, folder, robot = sys.argv[1:]
pose = np.array([0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8], np.float32)
stack = load(bundle, threads=1, envelope=robot, deadline_ms=9, fallback=Fallback(start=pose.tolist()),
             telemetry=Telemetry(JsonLines(folder + "/run.jsonl")), record=folder + "/run")
random = np.random.default_rng(0)
step = 0
while True:
    try:
        stack.act({"q": pose + random.normal(0, 1e-5, 7).astype(np.float32)})
    except Exception as error:
        print(error, file=sys.stderr)
    step += 1
    print(step, time.monotonic(), flush=True)
    time.sleep(0.01)
"""


def killed(bundle: str, folder: Path, seconds: float) -> dict[str, Any]:
    """Kill a child after so many seconds of acting; return what is left of its run."""
    command = [sys.executable, "-c", CHILD, bundle, str(folder), ROBOT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        first = child.stdout.readline()
        time.sleep(seconds)
        child.kill()
        told = [first, *child.stdout.read().splitlines()]
    times = {int(step): float(when) for step, when in (line.split() for line in told if len(line.split()) == 2)}
    ticks = sum(frame.kind is FrameKind.TICK for frame in read_run(folder / "run"))
    lines = [line["step"] for line in read_lines(folder / "run.jsonl")] if (folder / "run.jsonl").exists() else []
    assert lines == list(range(len(lines)))
    lost = {"recorded": _lost(times, ticks), "lines": _lost(times, len(lines))}
    return {"steps": max(times), "replayed": replay(folder / "run", bundle), "ticks": ticks, **lost}


def _lost(times: dict[int, float], steps: int) -> float:
    """Return the seconds from the last control step that a file has to the last one that the child told of."""
    last = times[max(times)]
    return last - times.get(steps, last if steps else min(times.values()))


def kills(count: int, seed: int = 0) -> dict[str, Any]:
    """Return what was seen of so many kills."""
    random, seen = np.random.default_rng(seed), []
    with tempfile.TemporaryDirectory() as folder:
        bundle = small_bundle(Path(folder) / "policy", 100.0)
        for number in range(count):
            own = Path(folder) / str(number)
            own.mkdir()
            seen.append(killed(bundle, own, random.uniform(0.05, 1.0)))
    return {
        "steps": sum(each["steps"] for each in seen),
        "bit-equal": sum(each["replayed"].equal and each["replayed"].steps == each["ticks"] for each in seen),
        "seconds lost of the recording": max(each["recorded"] for each in seen),
        "seconds lost of the lines": max(each["lines"] for each in seen),
    }


def main() -> None:
    """Print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    count = parser.parse_args().kills
    found = kills(count)
    print(f"{count} kills after {found['steps']:,} control steps: {found['bit-equal']} recordings readable and "
          f"bit-equal; at most {found['seconds lost of the recording']:.2f} s of a recording and "
          f"{found['seconds lost of the lines']:.2f} s of the lines lost")  # fmt: skip


if __name__ == "__main__":
    main()
