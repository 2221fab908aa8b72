"""Change a bundle at random, load it, and see that it is refused by name or answers as before.

``python tests/validation/soak/attacks/mutants.py --tries 1000000`` changes bits, cuts, swaps, inserts and edits in
every file, the manifest and its digest included. For one try in five the attacker repairs the hashes and the digest;
for a quarter of those the golden check is taken away, too. Every try runs ``load`` and four inferences in a worker
process; a worker that dies, takes more than 10 s for a try, or grows by more than 1 GB is counted and replaced.

The exit status is 1 when one of the rows that must be 0 is not.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import victim
from mutations import Files, mutated, read, repaired, without_golden

from vlatool.errors import VlatoolError
from vlatool.files import verified_read

HANG = 10.0
MEMORY = 1 << 30
BATCH = 2000
TOLD_S = 60.0
REFUSED = "refused: "
SAME = "loaded, same answer"
UNREPAIRED = "hashes not repaired, another answer"
CAUGHT_NOT = "hashes repaired, golden file as it was, another golden answer"
SLIGHT = "(hashes repaired, golden file as it was: other answers only within the golden tolerance or elsewhere)"
TAKEN = "(hashes repaired, golden check taken away or changed, another answer)"
RAW, CRASH, SLOW, LARGE = "raw exception", "crash of a worker", "longer than 10 s", "more than 1 GB"
ZERO = (UNREPAIRED, CAUGHT_NOT, RAW, CRASH, SLOW, LARGE)


@dataclass
class Found:
    """What came of the tries."""

    counts: Counter[str] = field(default_factory=Counter)
    examples: dict[str, list[str]] = field(default_factory=dict)

    def add(self, outcome: str, note: str = "") -> None:
        """Count one try, and keep the first notes of what must not be."""
        self.counts[outcome] += 1
        if outcome in ZERO and len(self.examples.setdefault(outcome, [])) < 5:
            self.examples[outcome].append(note)

    def merge(self, counts: dict[str, int], examples: dict[str, list[str]]) -> None:
        """Add what another process found."""
        self.counts.update(counts)
        for outcome, notes in examples.items():
            self.examples[outcome] = (self.examples.get(outcome, []) + notes)[:5]


class Attack:
    """One place in memory where mutants are written and loaded."""

    def __init__(self, original: Files, folder: Path, seed: int) -> None:
        self.original, self.folder, self.seed = original, folder, seed
        self.there: Files = {}
        self.write(original)
        self.wanted = victim.answers(folder)

    def write(self, files: Files) -> None:
        """Bring the folder to these files, writing only what differs."""
        for name in set(self.there) - set(files):
            (self.folder / name).unlink()
        for name in {str(Path(name).parent) for name in set(self.there) - set(files)} - {"."}:
            if name not in {str(Path(other).parent) for other in files}:
                shutil.rmtree(self.folder / name)
        for name, content in files.items():
            if self.there.get(name) != content:
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                (self.folder / name).write_bytes(content)
        self.there = files

    def attempt(self, number: int, found: Found) -> None:
        """Make one mutant, load it, and count what came of it."""
        chance = random.Random(f"{self.seed}:{number}")
        files = mutated(self.original, chance)
        golden = False
        fixed = chance.random() < 0.2
        if fixed:
            golden = chance.random() < 0.25
            files = repaired(without_golden(files) if golden else files, self.original)
        self.write(files)
        started = time.monotonic()
        try:
            got = victim.answers(self.folder)
        except VlatoolError as error:
            found.add(f"{REFUSED}{type(error).__name__}")
        except Exception as error:
            found.add(RAW, f"try {number}: {type(error).__name__}: {str(error)[:200]}")
        else:
            found.add(*self._judged(got, files, number, fixed, golden))
        if time.monotonic() - started > HANG:
            found.add(SLOW, f"try {number}")

    def _judged(self, got: list[Any], files: Files, number: int, fixed: bool, golden: bool) -> tuple[str, str]:
        if victim.equal(self.wanted, got):
            return SAME, ""
        if not fixed:
            return UNREPAIRED, f"try {number}"
        if golden or self._golden(files) != self._golden(self.original):
            return TAKEN, ""
        return (CAUGHT_NOT if victim.far(self.wanted, got) else SLIGHT), f"try {number}"

    @staticmethod
    def _golden(files: Files) -> Any:
        """The golden check of a bundle: the file, and that the manifest names it."""
        named = json.loads(files["manifest.json"]).get("golden")
        return named, files.get(str(named))


def work(original: Files, folder: Path, seed: int, numbers: range, now: mmap.mmap, out: Path) -> None:
    """Go through some tries in this process; what was found is written after each that may be the last."""
    warnings.simplefilter("ignore")
    verified_read.TICK_NS = 0  # nobody else writes here, so that nothing can change within a tick of the clock
    found = Found()
    attack = Attack(original, folder, seed)
    inherited = peak_memory()
    for number in numbers:
        now[:16] = struct.pack("<qd", number, time.monotonic())
        attack.attempt(number, found)
        growth = peak_memory() - inherited
        if growth > MEMORY or number == numbers[-1] or not number % 50:
            if growth > MEMORY:
                found.add(LARGE, f"try {number}: {growth >> 20} MB")
            done = {"next": number + 1, "counts": found.counts, "examples": found.examples}
            out.with_suffix(".new").write_text(json.dumps(done))
            out.with_suffix(".new").replace(out)
            if growth > MEMORY:
                return


def peak_memory() -> int:
    """Return the most memory that this process had, in bytes: a fork begins with that of the process it is made by."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class Worker:
    """A process that goes through a range of tries, and is replaced when it dies or hangs."""

    def __init__(self, original: Files, place: Path, seed: int, numbers: range, found: Found) -> None:
        self.original, self.place, self.seed, self.numbers, self.found = original, place, seed, numbers, found
        self.now = mmap.mmap(-1, 16)
        self.start(numbers.start)

    def start(self, first: int) -> None:
        """Fork a process from a try on."""
        self.first = first
        self.out = self.place / f"{first}.json"
        folder = Path(tempfile.mkdtemp(dir=self.place))
        self.now[:16] = struct.pack("<qd", first, time.monotonic())
        sys.stdout.flush()
        self.pid = os.fork()
        if not self.pid:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            try:
                work(self.original, folder, self.seed, range(first, self.numbers.stop), self.now, self.out)
            except BaseException:
                os._exit(3)
            os._exit(0)

    def ended(self) -> bool:
        """Look after the process; say whether the whole range is done."""
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        number, since = struct.unpack("<qd", self.now[:16])
        if not pid and time.monotonic() - since < 2 * HANG:
            return False
        if not pid:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        told = (
            json.loads(self.out.read_text())
            if self.out.exists()
            else {"next": self.first, "counts": {}, "examples": {}}
        )
        self.found.merge(told["counts"], told["examples"])
        if not status and pid:
            return told["next"] >= self.numbers.stop or self._again(told["next"])
        self.found.add(CRASH if pid else SLOW, f"try {number}: status {status}")
        if number > told["next"]:  # what was tried since the last report runs again, up to the try that did not return
            self._between(told["next"], number)
        return number + 1 >= self.numbers.stop or self._again(number + 1)

    def _between(self, first: int, end: int) -> None:
        inner = Worker(self.original, self.place, self.seed, range(first, end), self.found)
        while not inner.ended():
            time.sleep(0.05)

    def _again(self, first: int) -> bool:
        self.start(first)
        return False


def soak(tries: int, seed: int, workers: int) -> Found:
    """Make so many mutants in some processes at a time."""
    found, told = Found(), time.monotonic() + TOLD_S
    place = Path(tempfile.mkdtemp(prefix="mutants-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    try:
        original = read(victim.make(place / "original").path)
        waiting = [range(first, min(first + BATCH, tries)) for first in range(0, tries, BATCH)][::-1]
        running: list[Worker] = []
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(Worker(original, place, seed, waiting.pop(), found))
            running = [worker for worker in running if not worker.ended()]
            time.sleep(0.02)
            if time.monotonic() > told:
                told += TOLD_S
                print(f"... {sum(found.counts.values())} of {tries}", file=sys.stderr, flush=True)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return found


def table(found: Found, tries: int, seconds: float) -> str:
    """Return what was found, one row an outcome."""
    lines = [f"{tries} tries in {seconds:.0f} s: {tries / seconds:.0f} each second"]
    rows = [*sorted(name for name in found.counts if name.startswith(REFUSED)), SAME, SLIGHT, TAKEN]
    lines += [f"{found.counts[name]:>10}  {name}" for name in rows]
    lines += [f"{found.counts[name]:>10}  {name} (must be 0)" for name in ZERO]
    lines += [f"            {note}" for name in ZERO for note in found.examples.get(name, [])]
    return "\n".join(lines)


def main() -> int:
    """Read the options, attack, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--tries", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    started = time.monotonic()
    found = soak(options.tries, options.seed, options.workers)
    print(table(found, options.tries, time.monotonic() - started))
    return int(any(found.counts[name] for name in ZERO))


if __name__ == "__main__":
    sys.exit(main())
