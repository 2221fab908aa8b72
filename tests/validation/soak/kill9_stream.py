"""Kill ``vlatool quantize weight-only`` at random moments and let the next run of the same command go on.

    python tests/validation/soak/kill9_stream.py --kills 30 [--layers 12]

A policy of some 70 million parameters is streamed from its shards by several processes. Each round starts from nothing,
kills the command (SIGKILL) once or twice, runs it to the end and compares every byte with the reference. Only the
command itself is killed: its worker processes have to end by themselves.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from kill9 import differences, drafts

from vlatool.bundle.bundle import Bundle, BundleError

POLICY = {"width": 512, "heads": 8, "shared_heads": 8, "head_width": 64, "hidden": 1376}


class StreamWork:
    """One command with its output, cache and reference."""

    def __init__(self, policy: Path, folder: Path) -> None:
        self.policy, self.folder = policy, folder
        self.out, self.cache, self.reference = folder / "place/out", folder / "cache", folder / "reference"
        self.counts: Counter[str] = Counter()
        self.records = 0

    def start(self) -> subprocess.Popen[str]:
        """Start the command."""
        self.out.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "vlatool", "quantize", "weight-only", str(self.policy), "-o", str(self.out)]
        with (self.folder / "stderr").open("w") as errors:
            return subprocess.Popen(
                command,
                env={**os.environ, "VLATOOL_CACHE": str(self.cache)},
                stdout=subprocess.DEVNULL,
                stderr=errors,
                text=True,
            )

    def run(self) -> str:
        """Run to the end; return what was wrong."""
        status = self.start().wait()
        return "" if status == 0 else f"exit {status}: {(self.folder / 'stderr').read_text()[-400:]}"

    def clear(self) -> None:
        """Remove output and cache."""
        for folder in (self.out.parent, self.cache):
            shutil.rmtree(folder, ignore_errors=True)

    def make_reference(self) -> float:
        """Run once to the end and keep the bundle; return the seconds it took."""
        self.clear()
        begun = time.perf_counter()
        if wrong := self.run():
            raise SystemExit(f"the reference run failed, {wrong}")
        shutil.copytree(self.out, self.reference)
        self.records = len(json.loads((self.out / "reports/weights.json").read_text())["layers"])
        return time.perf_counter() - begun

    def finished(self) -> int:
        """Count the records in the journal of unfinished work."""
        return sum(len(path.read_bytes().splitlines()) - 1 for path in self.cache.glob("streams/*/journal"))

    def kill_after(self, wanted: int, delay: float) -> bool:
        """Start the command and kill it ``delay`` seconds after so many records are finished; False when it ended."""
        process = self.start()
        while process.poll() is None and self.finished() < wanted:
            time.sleep(0.005)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=delay)
        alive = process.poll() is None
        if alive:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        return alive

    def round(self, moments: list[tuple[int, float]]) -> list[str]:
        """Start from nothing, kill at each moment, run to the end; return what was violated."""
        self.clear()
        violations = []
        kept = 0
        for wanted, delay in moments:
            self.counts["killed" if self.kill_after(wanted, delay) else "ended before the kill"] += 1
            kept = 0 if self.out.exists() else self.finished()
            if self.out.exists():
                try:
                    Bundle.open(self.out)
                except BundleError as error:
                    violations.append(f"half a bundle after the kill: {error}")
                break
        if kept:
            self.counts["killed with finished records"] += 1
        wrong = self.run() if not self.out.exists() else ""
        if wrong:
            return [*violations, f"the run after the kill: {wrong}"]
        resumed = json.loads((self.out / "reports/weights.json").read_text())["resumed"]
        if kept and not kept - 1 <= resumed <= kept:
            violations.append(f"{kept} records were finished, {resumed} were taken over")
        violations += differences(self.reference, self.out)
        violations += [f"left over: {path}" for path in (*drafts(self.folder), *self.cache.glob("streams/*"))]
        return violations


def make_policy(folder: Path, layers: int) -> Path:
    """Write the policy."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    from _llama import write_llama

    from vlatool.samples._language import DecoderShape

    write_llama(folder, shape=DecoderShape(layers=layers, **POLICY), length=8, shard_bytes=1 << 25)
    return folder


def soak(work: StreamWork, kills: int, seed: int, tell: Callable[[str], None] = print) -> list[str]:
    """Make the reference, kill at ``kills`` moments, one or two in a round; return every violation."""
    seconds = work.make_reference()
    tell(f"one run takes {seconds:.1f} s")
    total = work.records
    choice = random.Random(seed)
    violations: list[str] = []
    done = 0
    while done < kills:
        rounds = range(min(choice.choice((1, 2)), kills - done))
        half = total // 2
        moments = [(part * half + choice.randrange(half + 1), choice.choice((0, 0.01, 0.1, 1))) for part in rounds]
        done += len(moments)
        for violation in work.round(moments):
            violations.append(violation)
            tell(f"VIOLATED, kills at {moments}: {violation}")
    work.counts["violations"] += len(violations)
    return violations


def main() -> int:
    """Soak and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--layers", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="vlatool-kill9-stream-") as scratch:
        work = StreamWork(make_policy(Path(scratch) / "policy", given.layers), Path(scratch))
        violations = soak(work, given.kills, given.seed)
    for kind, count in work.counts.items():
        print(f"{kind:36}{count:>8}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
