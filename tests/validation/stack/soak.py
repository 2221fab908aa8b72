"""The whole stack and a client for an hour: memory, descriptors and threads stay as they are.

    python tests/validation/stack/soak.py --minutes 60

A policy with a deadline, a fallback, the envelope of a robot, anomaly monitors, telemetry in all its sinks (lines of
JSON that rotate, a file and a port for Prometheus, health, cadence) and a recorder acts at 100 Hz; one inference of
fifty is late, episodes are reset, and a client asks the port once a second. Prints the slope of the resident memory by
least squares after a sixth of the time (ten minutes of an hour), and the descriptors and threads.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from overhead import ROBOT, small_bundle

from vlatool.errors import DeadlineMissed
from vlatool.runtime import load
from vlatool.runtime.stack import Fallback, Stack
from vlatool.runtime.telemetry import Telemetry
from vlatool.runtime.telemetry.cadence import Cadence
from vlatool.runtime.telemetry.health import Health, Timeout
from vlatool.runtime.telemetry.json_lines import JsonLines
from vlatool.runtime.telemetry.prometheus import Prometheus

RATE, LATE, EPISODE = 100.0, 50, 1000
POSE = np.array([0.0, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8], np.float32)


def resident_mb() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def stack_of(folder: Path, health: Health, server: Prometheus) -> Stack:
    """Return the whole stack around a small policy."""
    sinks = JsonLines(folder / "run.jsonl", max_bytes=200_000, health=health), server, health, Cadence(10_000)
    stack = load(
        small_bundle(folder, RATE), threads=1, envelope=ROBOT, deadline_ms=8, fallback=Fallback(start=POSE.tolist()),
        controllers=["anomaly"], telemetry=Telemetry(*sinks, Prometheus(folder / "run.prom", health=health)),
        record=folder / "run.vlarun",
    )  # fmt: skip
    assert isinstance(stack, Stack)
    return stack


def sometimes_late(infer: Any) -> Any:
    """Return an ``infer`` of which one in ``LATE`` misses its deadline."""
    calls = iter(range(10**12))

    def late(observation: Any, *, noise: Any = None) -> Any:
        if next(calls) % LATE == LATE - 1:
            raise DeadlineMissed("There is no action within 8 ms: it was stopped.")
        return infer(observation, noise=noise)

    return late


def ask(port: int, ends: threading.Event) -> None:
    """Ask for the numbers once a second."""
    while not ends.wait(1.0):
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            answer.read()


def soak(seconds: float, every: float = 5.0) -> dict[str, Any]:
    """Act for so many seconds; return what was seen every few seconds."""
    seen: list[tuple[float, float, int, int]] = []
    random, ends = np.random.default_rng(0), threading.Event()
    with tempfile.TemporaryDirectory() as name:
        health = Health({"policy": Timeout(0.5, 2.0), "controller": Timeout(0.5, 2.0)})
        server = Prometheus(port=0, health=health)
        stack = stack_of(Path(name), health, server)
        stack.deadlines[0].infer = sometimes_late(stack.deadlines[0].infer)  # type: ignore[method-assign]
        client = threading.Thread(target=ask, args=(server.port, ends))
        client.start()
        begin, step, due = time.monotonic(), 0, 0.0
        while (now := time.monotonic() - begin) < seconds:
            stack.act({"q": POSE + random.normal(0, 1e-5, 7).astype(np.float32)}, scheduled=begin + step / RATE)
            stack.note_delivery()
            step += 1
            if step % EPISODE == 0:
                stack.reset()
            if now >= due:
                seen.append((now, resident_mb(), len(os.listdir("/proc/self/fd")), threading.active_count()))
                due = now + every
            time.sleep(max(0.0, begin + step / RATE - time.monotonic()))
        ends.set()
        client.join()
        stack.close()
        size = sum(file.stat().st_size for file in Path(name).iterdir() if file.name.startswith("run.jsonl"))
        told = stack.telemetry
        assert told is not None
        return {"steps": step, "seen": np.array(seen), "lines MB": size / 1e6, "dropped": told.drop_count,
                "failed": told.failure_count, "misses": server.metrics.misses}  # fmt: skip


def slope_mb_per_hour(seen: Any) -> float:
    """Return the slope of the resident memory after a sixth of the time."""
    rows = seen[seen[:, 0] >= seen[-1, 0] / 6]
    return float(np.polyfit(rows[:, 0] / 3600, rows[:, 1], 1)[0])


def main() -> None:
    """Print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    found = soak(60 * parser.parse_args().minutes)
    seen = found.pop("seen")
    late = seen[seen[:, 0] >= seen[-1, 0] / 6]
    print(f"{found['steps']:,} control steps, {found['misses']:,} missed; telemetry: {found['lines MB']:.2f} MB of "
          f"lines, {found['dropped']} dropped, {found['failed']} failed")  # fmt: skip
    print(f"resident memory {late[0, 1]:.2f} MB to {late[-1, 1]:.2f} MB: {slope_mb_per_hour(seen):+.3f} MB/h; "
          f"descriptors {late[:, 2].min():.0f} to {late[:, 2].max():.0f}, "
          f"threads {late[:, 3].min():.0f} to {late[:, 3].max():.0f}")  # fmt: skip


if __name__ == "__main__":
    main()
