"""kill -9 at random instants of updates: the active slot always loads; of an in-place update it does not.

Usage: python tests/validation/updates/update_kills.py --kills 1000

Each kill ends a process that deploys one bundle after the other, goes back and commits. The store then must name a slot
whose bundle is whole, verified file by file; one in 50 is also loaded and asked for an action. The same number of kills
(--control) hits a process that copies the new files over the old ones, as scp and rsync --inplace do.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from _slots import OBSERVATION, bundle_of, install

from vlatool.bundle.bundle import Bundle
from vlatool.deployment.deploy import open_slot
from vlatool.deployment.store import Store
from vlatool.errors import VlatoolError
from vlatool.runtime import load

LOAD_EACH = 50
LONGEST_S = 0.25


def updates(store: Store, bundles: list[Bundle]) -> None:
    """Change the store without end."""
    while True:
        for bundle in bundles:
            if (current := store.read().current) is not None and current.bundle == bundle.hash:
                continue
            slot = install(store, bundle)
            store.count_start(slot.bundle, 1)
            store.commit(slot.bundle)
            store.roll_back("exercise")


def updates_in_place(folder: Path, bundles: list[Bundle]) -> None:
    """Copy the files of one bundle after the other over those of the last one."""
    while True:
        for bundle in bundles:
            for path in sorted(bundle.path.rglob("*")):
                if path.is_file():
                    target = folder / path.relative_to(bundle.path)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(path.read_bytes())


def killed(work: Callable[[], None], seconds: float) -> None:
    """Run work in a child process and kill it after some seconds."""
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            work()
        os._exit(1)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1]), "the child ended on its own: see what install() raises"


def whole(store: Store, *, opened: bool) -> bool:
    """Return whether the active slot is the bundle that the pointer names; whether it also answers if ``opened``."""
    try:
        pointer = store.read_deployed()
        for name, slot in pointer.slots.items():
            open_slot(store, name, slot).verify()
        if opened:
            load(store.folder(pointer.active), threads=1).infer(OBSERVATION)
    except VlatoolError as error:
        print(error, file=sys.stderr)
        return False
    return True


def run(kills: int, control: int, seed: int, folder: Path) -> tuple[int, int, int]:
    """Return how many active slots were broken, how many changes there were, and how many in place were broken."""
    draw = random.Random(seed)
    bundles = [bundle_of(folder / f"bundle {value}", value) for value in (1, 2, 3)]
    store = Store(folder / "store")
    install(store, bundles[0], trial=None)
    install(store, bundles[1], trial=None)
    broken, before = 0, store.read().change
    for number in range(kills):
        killed(lambda: updates(store, bundles), draw.uniform(0, LONGEST_S))
        broken += not whole(store, opened=not number % LOAD_EACH)
    changes = store.read().change - before
    place, broken_in_place = Path(shutil.copytree(bundles[0].path, folder / "in place")), 0
    for _ in range(control):
        killed(lambda: updates_in_place(place, bundles), draw.uniform(0, LONGEST_S))
        try:
            Bundle.open(place)
        except VlatoolError:
            broken_in_place += 1
    return broken, changes, broken_in_place


def main() -> int:
    """Print the counts; 1 when an active slot was broken, or the control was not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--control", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        broken, changes, in_place = run(given.kills, given.control, given.seed, Path(folder))
    print(f"{given.kills} kills during {changes} changes of the pointer: {broken} active slots broken")
    print(f"in place: {in_place} of {given.control} bundles broken")
    return int(broken > 0 or in_place == 0)


if __name__ == "__main__":
    sys.exit(main())
