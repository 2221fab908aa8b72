"""A power cut after each call of an update, with each of many subsets of what was not flushed: the active slot loads.

Usage: python tests/validation/updates/update_crashes.py --draws 20

Records the calls (open, write, fsync, rename, unlink, mkdir, rmdir) of a first deployment, of others into an empty and
into a full slot, of a start, a commit and a rollback, and makes what a cut after each of them may leave (``_disk.py``).
In each state the active bundle must be whole and the old or the new one, and an update must go through again. Two
controls show that the states are not harmless: the same calls without their flushes, and files copied in place.
With --strace the record is held against what strace sees of the same process.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from _disk import Recorder, states
from _slots import bundle_of, install

from vlatool.bundle.bundle import Bundle
from vlatool.deployment.deploy import open_slot
from vlatool.deployment.store import Store
from vlatool.errors import VlatoolError
from vlatool.files.durable import sync_folder, write_file

MARKS = ("/no such file: begin", "/no such file: end")
SYSTEM_CALLS = {"write": "write", "fsync": "fsync", "rename": "rename", "unlink": "remove", "rmdir": "remove",
                "mkdir": "mkdir"}  # fmt: skip
AGAIN_EACH = 25
"""States of which one is updated again."""


def cases(bundles: list[Bundle]) -> dict[str, tuple[int, Callable[[Store], object]]]:
    """Return name -> bundles that are deployed before, and the change that is cut."""
    one, two, three = bundles
    return {
        "first deployment": (0, lambda store: install(store, one)),
        "deployment into an empty slot": (1, lambda store: install(store, two)),
        "deployment into a full slot": (2, lambda store: install(store, three)),
        "start of a trial": (2, lambda store: store.count_start(two.hash, 1)),
        "commit": (2, lambda store: store.commit(two.hash)),
        "rollback": (2, lambda store: store.roll_back("a cut")),
    }


def recorded(folder: Path, bundles: list[Bundle], before: int, change: Callable[[Store], object]) -> Recorder:
    """Record a change of a store that holds the first bundles."""
    store = Store(folder)
    store.make()
    for bundle in bundles[:before]:
        install(store, bundle)
    recorder = Recorder(folder)
    with recorder.recording():
        change(store)
    return recorder


def problem(store: Store, allowed: set[str], *, first: bool) -> str:
    """Return what is wrong with a store after a cut, empty when nothing is."""
    try:
        pointer = store.read()
        if pointer.current is None:
            return "" if first else "there is no active bundle"
        open_slot(store, pointer.active, pointer.current).verify()
        return "" if pointer.current.bundle in allowed else "another bundle is active"
    except VlatoolError as error:
        return error.message


def cut(recorder: Recorder, bundles: list[Bundle], place: Path, draws: int, seed: int, *, first: bool,
        flushed: bool = True, each: int = 1) -> tuple[int, list[str]]:  # fmt: skip
    """Return how many states there are, and what is wrong with those of each so many that are wrong."""
    allowed, wrong, count = {bundle.hash for bundle in bundles}, [], 0
    for count, (step, disk) in enumerate(states(recorder, draws, seed, flushed=flushed), 1):
        if count % each:
            continue
        folder = place / "state"
        disk.write_to(folder)
        found = problem(Store(folder), allowed, first=first)
        if not found and flushed and not count % AGAIN_EACH:
            current = Store(folder).read().current
            other = next(bundle for bundle in bundles if current is None or bundle.hash != current.bundle)
            install(Store(folder), other)
            found = problem(Store(folder), {other.hash}, first=False)
        wrong += [f"after step {step}: {found}"] if found else []
        shutil.rmtree(folder)
    return count, wrong


def in_place(folder: Path, bundles: list[Bundle], draws: int, seed: int) -> tuple[int, int]:
    """Return how many states of an update in place were made, and how many hold no whole bundle."""
    target = Path(shutil.copytree(bundles[0].path, folder / "in place"))
    recorder = Recorder(target)
    with recorder.recording():
        for path in sorted(bundles[1].path.rglob("*")):
            if path.is_file():
                write_in_place(target / path.relative_to(bundles[1].path), path.read_bytes())
    broken = count = 0
    for _, disk in states(recorder, draws, seed):
        count += 1
        disk.write_to(folder / "state")
        try:
            Bundle.open(folder / "state")
        except VlatoolError:
            broken += 1
        shutil.rmtree(folder / "state")
    return count, broken


def write_in_place(path: Path, content: bytes) -> None:
    """Overwrite a file and flush it, as a careful copy does."""
    write_file(path, [content])
    sync_folder(path.parent)


def counted(recorder: Recorder) -> dict[str, int]:
    """Return how many calls of each kind were recorded."""
    kinds = Counter("fsync" if isinstance(step, int) else step.kind for step in recorder.steps)
    return dict(sorted(kinds.items()))


def traced(folder: Path) -> tuple[dict[str, int], dict[str, int]]:
    """Return the calls that a process records of a deployment, and those that strace sees of it."""
    words = [sys.executable, __file__, "--record", str(folder / "traced")]
    log = folder / "strace.txt"
    done = subprocess.run(["strace", "-f", "-y", "-o", log, *words], capture_output=True, text=True, check=True)
    lines = log.read_text().splitlines()
    first, last = (next(at for at, line in enumerate(lines) if mark in line) for mark in MARKS)
    kinds: Counter[str] = Counter()
    for line in lines[first:last]:
        name = line.split("(")[0].split()[-1]
        kind = SYSTEM_CALLS.get(name, "create" if name == "openat" and "O_CREAT" in line else "")
        if str(folder / "traced/store") in line and " = -1 " not in line and kind:
            kinds[kind] += 1
    return json.loads(done.stdout), dict(sorted(kinds.items()))


def record(folder: Path) -> None:
    """Record a deployment into a full slot, between two calls that show in a trace, and print what was recorded."""
    folder.mkdir()
    bundles = [bundle_of(folder / f"bundle {value}", value) for value in (1, 2, 3)]
    before, change = cases(bundles)["deployment into a full slot"]

    def marked(store: Store) -> None:
        os.path.exists(MARKS[0])
        change(store)
        os.path.exists(MARKS[1])

    print(json.dumps(counted(recorded(folder / "store", bundles, before, marked))))


def main() -> int:
    """Print a line for each case; 1 when an active slot is broken, or a control is not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--strace", action="store_true")
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.record is not None:
        record(given.record)
        return 0
    failed = False
    shared = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=shared) as name:
        folder = Path(name)
        bundles = [bundle_of(folder / f"bundle {value}", value) for value in (1, 2, 3)]
        if given.strace:
            ours, theirs = traced(folder)
            print(f"recorded {ours}; strace {theirs}")
            failed |= ours != theirs
        for number, (case, (before, change)) in enumerate(cases(bundles).items()):
            recorder = recorded(folder / f"store {number}", bundles, before, change)
            first = before == 0
            count, wrong = cut(recorder, bundles, folder, given.draws, given.seed, first=first)
            line = f"{case}: {len(recorder.steps)} calls, {count} states, {len(wrong)} broken"
            if before:
                _, loose = cut(recorder, bundles, folder, given.draws, given.seed, first=first, flushed=False)
                line += f"; without flushes {len(loose)} broken"
            print("\n  ".join([line, *wrong[:5]]), flush=True)
            failed |= bool(wrong)
        count, broken = in_place(folder, bundles, given.draws, given.seed)
        print(f"in place: {broken} of {count} states broken")
    return int(failed or not broken)


if __name__ == "__main__":
    sys.exit(main())
