"""Kill a training at random moments, again and again, and see that it ends with the weights of an undisturbed one.

``python tests/soak/kill9_train.py --kills 20`` prunes the tiny policy of the tests, distils it once without a kill (the
reference), then starts the same command from nothing and kills its whole process group at moments drawn uniformly over
the duration of the reference, each time going on from what the last kill left. A round ends when the command runs to
its end; rounds follow each other until there were so many kills. After each kill the output is absent or whole; at the
end of each round the bundle is the reference's byte for byte (``reports/`` apart, which hold times), and no unfinished
work is left. Options after ``--`` are added to the command, as ``-- --processes 2``.

Prints counts; the exit status is 1 when anything was violated.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from kill9 import Work, differences, drafts, make_policy

from vlatool.bundle.bundle import Bundle
from vlatool.errors import BundleError

SHORT = ["--steps", "200", "--batch", "8", "--every", "40", "--episodes", "6", "--student-episodes", "2"]
LATEST = 0.98
"""Share of the reference's duration up to which is killed."""


def training(folder: Path, options: list[str]) -> Work:
    """Prepare a policy and its pruned bundle; return the command that distils that."""
    policy = make_policy(folder / "tiny")
    prune = Work(["prune", "neurons", str(policy), "--ratio", "0.7"], folder / "prune")
    prune.make_reference()
    words = ["distill", "policy", str(prune.reference), "--trust", str(policy), *SHORT, *options]
    return Work(words, folder / "train")


def rounds(work: Work, kills: int, seed: int, tell: Callable[[str], None] = print) -> list[str]:
    """Make the reference; kill so many times, over as many rounds as that takes; return every violation."""
    seconds = work.make_reference()
    tell(f"one run takes {seconds:.1f} s")
    moments, violations = random.Random(seed), list[str]()
    while work.counts["killed"] < kills:
        work.clear()
        while work.counts["killed"] < kills and not work.out.exists():
            moment = moments.uniform(0, seconds * LATEST)
            found = kill(work, moment)
            tell(f"kill {work.counts['killed']} at {moment:.2f} s: {found or checkpoint(work)}")
            violations += found
        violations += end(work)
        work.counts["rounds"] += 1
    return violations


def kill(work: Work, moment: float) -> list[str]:
    """Start or go on, kill after ``moment`` seconds, and look."""
    process = work.start()
    try:
        process.wait(timeout=moment)
        work.counts["ended before the kill"] += 1
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        work.counts["killed"] += 1
    wait_for_children(work)
    if not work.out.exists():
        return []
    try:
        Bundle.open(work.out)
    except BundleError as error:
        return [f"half a bundle after the kill: {error}"]
    return differences(work.reference, work.out)


def wait_for_children(work: Work, most_s: float = 20.0) -> None:
    """Wait until no process is left that names the folder of the work: children die with their parents, not at once."""
    end_at = time.monotonic() + most_s
    while time.monotonic() < end_at and any(_names(entry, work.cache) for entry in Path("/proc").glob("[0-9]*")):
        time.sleep(0.05)


def _names(entry: Path, folder: Path) -> bool:
    try:
        return f"VLATOOL_CACHE={folder}".encode() in (entry / "environ").read_bytes().split(b"\0")
    except OSError:
        return False


def checkpoint(work: Work) -> str:
    """Say how far the training had come."""
    found = [path.stat().st_size for path in work.cache.glob("streams/*/checkpoint.safetensors")]
    parts = sorted(path.name for path in work.cache.glob("streams/*/round-???"))
    return f"{'a checkpoint' if found else 'no checkpoint'}, {len(parts)} rounds"


def end(work: Work) -> list[str]:
    """Run to the end, and hold the bundle against the reference."""
    if not work.out.exists() and (wrong := work.run()):
        return [f"the run after the kills: {wrong}"]
    left = [f"left over: {path}" for path in (*drafts(work.folder), *work.cache.glob("streams/*/round-*"))]
    return differences(work.reference, work.out) + left


def main() -> int:
    """Soak and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("options", nargs="*", help="of vlatool distill policy, behind --")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="vlatool-kill9-") as scratch:
        work = training(Path(scratch), given.options)
        violations = rounds(work, given.kills, given.seed, lambda line: print(line, flush=True))
    for violation in violations:
        print(f"VIOLATED {violation}")
    print(", ".join(f"{name}: {count}" for name, count in work.counts.items()), f"violations: {len(violations)}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
