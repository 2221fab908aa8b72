"""Kill a training at random moments, again and again, and see that it ends with the weights of an undisturbed one.

``python tests/validation/soak/kill9_train.py --kills 20`` prunes the tiny policy of the tests, distils it once without
a kill (the reference), then starts the same command from nothing and kills its whole process group at moments drawn
uniformly over the duration of the reference, each time going on from what the last kill left. A round ends when the
command runs to its end; rounds follow each other until there were so many kills. After each kill the output is absent
or whole; at the end of each round the bundle is the reference's byte for byte (``reports/`` apart, which hold times),
and no unfinished work is left. ``--command qat`` and ``--command gradual`` kill ``quantize qat`` and ``prune gradual``
in the same way. Options after ``--`` are added to the command, as ``-- --processes 2``.

Prints counts; the exit status is 1 when anything was violated.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from kill9 import Work, make_policy

SHORT = ["--steps", "200", "--batch", "8", "--every", "40", "--episodes", "6", "--student-episodes", "2"]
COMMANDS = {"distill": ["distill", "policy"], "qat": ["quantize", "qat"], "gradual": ["prune", "gradual"]}
LATEST = 0.98
"""Share of the reference's duration up to which is killed."""


def training(folder: Path, options: list[str], command: str = "distill") -> Work:
    """Prepare a policy and its pruned bundle; return the command that trains that."""
    policy = make_policy(folder / "tiny")
    prune = Work(["prune", "neurons", str(policy), "--ratio", "0.7"], folder / "prune")
    prune.make_reference()
    words = [*COMMANDS[command], str(prune.reference), "--trust", str(policy), *SHORT, *options]
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
            found = work.kill(moment)
            tell(f"kill {work.counts['killed']} at {moment:.2f} s: {found or checkpoint(work)}")
            violations += found
        violations += end(work)
        work.counts["rounds"] += 1
    return violations


def checkpoint(work: Work) -> str:
    """Say how far the training had come."""
    found = [path.stat().st_size for path in work.cache.glob("streams/*/checkpoint.safetensors")]
    parts = sorted(path.name for path in work.cache.glob("streams/*/round-???"))
    return f"{'a checkpoint' if found else 'no checkpoint'}, {len(parts)} rounds"


def end(work: Work) -> list[str]:
    """Run to the end, and hold the bundle against the reference."""
    if not work.out.exists() and (wrong := work.run()):
        return [f"the run after the kills: {wrong}"]
    return work.look_at_the_end() + [f"left over: {path}" for path in work.cache.glob("streams/*/round-*")]


def main() -> int:
    """Soak and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", choices=COMMANDS, default="distill")
    parser.add_argument("options", nargs="*", help="of the command, behind --")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="vlatool-kill9-") as scratch:
        work = training(Path(scratch), given.options, given.command)
        violations = rounds(work, given.kills, given.seed, lambda line: print(line, flush=True))
    for violation in violations:
        print(f"VIOLATED {violation}")
    print(", ".join(f"{name}: {count}" for name, count in work.counts.items()), f"violations: {len(violations)}")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
