"""Damaged pointers, signatures and slots: each is refused with an error of its own, none crashes, hangs or is accepted.

Usage: python tests/validation/updates/update_corruption.py --tries 1000000

Of the tries, a share goes to each kind (--kinds pointers,signatures,slots). A mutant flips, cuts, repeats, zeroes and
splices bytes, or (of JSON) replaces a value by one of another type or size and writes a fresh digest, as who knows the
format would. Such a forged pointer may be valid: then the bundle that it names must be the one in the slot.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import json
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from _slots import bundle_of, install

from vlatool.deployment import pointer as pointers
from vlatool.deployment import signature as signatures
from vlatool.deployment.deploy import open_slot
from vlatool.deployment.store import Store
from vlatool.errors import VlatoolError

HANG_S = 10
VALUES = (None, True, -1, 2**70, 1e308, "", "x" * 300, [], {}, [[[[]]]], "sha256:" + "0" * 64, "\u0000", 0.5, "a", "c")
SHARES = {"pointers": 0.5, "signatures": 0.3, "slots": 0.2}


def mutant(content: bytes, other: bytes, draw: random.Random) -> bytes:
    """Return changed bytes; they may be the same by chance."""
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 1, 2, 5))):
        at, end = sorted(draw.randrange(len(data) + 1) for _ in range(2))
        kind = draw.randrange(7)
        if kind == 0 and data:
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del data[at:end]
        elif kind == 2:
            data[at:at] = data[at : min(end, at + 64)]
        elif kind == 3:
            data[at:end] = bytes(end - at)
        elif kind == 4:
            data[at:end] = other[at:end]
        elif kind == 5:
            data[at:at] = draw.randbytes(draw.randrange(1, 9))
        else:
            data = data[:at]
        if not data:
            break
    return bytes(data)


def forged(plain: Any, draw: random.Random) -> Any:
    """Return a JSON value of which one part is another one."""
    if isinstance(plain, dict) and plain and draw.random() < 0.8:
        name = draw.choice(sorted(plain))
        chance = draw.random()
        if chance < 0.1:
            return {key: value for key, value in plain.items() if key != name}
        return {**plain, f"{name}x": 1} if chance < 0.2 else {**plain, name: forged(plain[name], draw)}
    return draw.choice(VALUES)


class Trial:
    """Counts what became of the mutants of one kind."""

    def __init__(self, folder: Path, draw: random.Random) -> None:
        self.draw = draw
        one, two = bundle_of(folder / "one", 1), bundle_of(folder / "two", 2)
        public = signatures.new_key(folder / "key")
        self.key, self.bundle = signatures.public_key(public), one
        self.signature = signatures.sign(one, public.with_suffix(""), 7).encode()
        self.other_signature = signatures.sign(two, public.with_suffix(""), 8).encode()
        self.store = Store(folder / "store")
        install(self.store, one)
        self.other_pointer = (self.store.path / pointers.FILES[0]).read_bytes()
        install(self.store, two)
        self.pointer = (self.store.path / pointers.FILES[0]).read_bytes()
        self.slot = self.store.folder(self.store.read().active)
        self.files = {path: path.read_bytes() for path in self.slot.rglob("*") if path.is_file()}
        self.current = self.store.read().current

    def pointers(self) -> str:
        """Read a mutant of a pointer."""
        changed = mutant(self.pointer, self.other_pointer, self.draw)
        if forge := self.draw.random() < 0.3:
            plain = forged(json.loads(self.pointer)["pointer"], self.draw)
            digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()
            changed = (json.dumps({"pointer": plain, "sha256": digest}, indent=1) + "\n").encode()
        try:
            found = pointers.decode(changed)
        except ValueError:
            return "refused"
        if changed in (self.pointer, self.other_pointer):
            return "unchanged"
        if not forge or found.current is None:
            return "forged" if forge else "accepted"
        try:
            open_slot(self.store, found.active, found.current)
        except VlatoolError:
            return "refused"
        return "forged"

    def signatures(self) -> str:
        """Verify a mutant of a signature."""
        changed = mutant(self.signature, self.other_signature, self.draw)
        if self.draw.random() < 0.3:
            changed = (json.dumps(forged(json.loads(self.signature), self.draw), indent=1) + "\n").encode()
        (self.bundle.path / signatures.SIGNATURE).write_bytes(changed)
        try:
            signatures.verify(self.bundle, [self.key])
        except VlatoolError:
            return "refused"
        return "unchanged" if changed == self.signature else "accepted"

    def slots(self) -> str:
        """Open a slot with one file changed, gone or beside others."""
        path = self.draw.choice(sorted(self.files))
        content = mutant(self.files[path], self.draw.choice(list(self.files.values())), self.draw)
        chance = self.draw.random()
        target = path.with_name("further") if chance < 0.05 else path
        if chance > 0.95:
            path.unlink()
        else:
            target.write_bytes(content)
        try:
            open_slot(self.store, self.slot.name, self.current).verify()
            return "unchanged" if content == self.files[path] and target == path else "accepted"
        except VlatoolError:
            return "refused"
        finally:
            target.unlink(missing_ok=True)
            path.write_bytes(self.files[path])


def run(trial: Trial, kind: str, tries: int, seconds: float) -> collections.Counter[str]:
    """Return how many mutants of a kind had which end."""
    attempt: Callable[[], str] = getattr(trial, kind)
    counts: collections.Counter[str] = collections.Counter()
    end = time.monotonic() + seconds
    for number in range(tries):
        if not number % 64:
            signal.alarm(HANG_S)
            if time.monotonic() > end:
                break
        try:
            counts[attempt()] += 1
        except Exception as error:  # what is looked for
            counts[f"crash: {type(error).__name__}: {error}"[:150]] += 1
    signal.alarm(0)
    return counts


def main() -> int:
    """Print the counts; 1 when a mutant crashed or was accepted (a hang ends the process with SIGALRM)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=1_000_000)
    parser.add_argument("--kinds", default=",".join(SHARES))
    parser.add_argument("--seconds", type=float, default=1e9, help="of each kind at most")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    bad = 0
    shared = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=shared) as folder:
        trial = Trial(Path(folder), random.Random(given.seed))
        for kind in given.kinds.split(","):
            counts = run(trial, kind, round(given.tries * SHARES[kind]), given.seconds)
            ends = ", ".join(f"{count:,} {end}" for end, count in counts.items())
            print(f"{kind}: {sum(counts.values()):,} mutants: {ends}", flush=True)
            bad += sum(count for end, count in counts.items() if end not in ("refused", "unchanged", "forged"))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
