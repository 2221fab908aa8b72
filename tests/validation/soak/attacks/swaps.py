"""Load a bundle while another thread swaps its graphs, and see that no load takes what was not hashed.

``python tests/validation/soak/attacks/swaps.py --loads 1000``: the thread renames other graphs, weights and whole
directories into place and back, writes into files, and puts links in their place; each load gives the right answers or
a typed error.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import victim

from vlatool.errors import VlatoolError

WRONG = "wrong answer"


class Swapper(threading.Thread):
    """Swaps files of a bundle for others of the same size, in every way in turn, until it is told to end."""

    def __init__(self, path: Path, pause: float) -> None:
        super().__init__(daemon=True)
        self.path, self.pause, self.over, self.swaps = path, pause, threading.Event(), 0
        self.evil, self.chance = path.parent / "evil", random.Random(0)
        shutil.copytree(path / "graphs", self.evil)
        weights = self.evil / "act.data"
        weights.write_bytes((-np.frombuffer(weights.read_bytes(), np.float32)).tobytes())
        graph = self.evil / "encode.onnx"
        data = np.load(path / "data/evaluation.npz")["state"]
        graph.write_bytes(graph.read_bytes().replace(b"Tanh", b"Sinh") if data.size else b"")

    def run(self) -> None:
        """Swap and swap back."""
        ways = (self.rename, self.rewrite, self.link, self.directory)
        while not self.over.is_set():
            for way in ways:
                for name in ("encode.onnx", "act.data"):
                    with contextlib.suppress(FileNotFoundError):
                        way(name)
                        self.swaps += 1

    def rename(self, name: str) -> None:
        """Another file is renamed over this one, and this one back."""
        place = self.path / "graphs" / name
        other, own = (self.path.parent / f"{kind}-{name}" for kind in ("other", "own"))
        shutil.copyfile(place, own)
        shutil.copyfile(self.evil / name, other)
        os.replace(other, place)
        time.sleep(self.pause)
        os.replace(own, place)
        self.rest()

    def rewrite(self, name: str) -> None:
        """The bytes are written over in place, and the old ones back; so is the time."""
        place = self.path / "graphs" / name
        before, found = place.read_bytes(), place.stat()
        for content in ((self.evil / name).read_bytes(), before):
            with place.open("r+b") as stream:
                stream.write(content)
            os.utime(place, ns=(found.st_atime_ns, found.st_mtime_ns))
            time.sleep(self.pause)
        self.rest()

    def rest(self) -> None:
        """Leave the bundle as it should be for a while, so that loads begin and end at every moment of a swap."""
        time.sleep(self.pause * self.chance.choice((1, 4, 16)))

    def link(self, name: str) -> None:
        """A link to another file takes the place."""
        place, away = self.path / "graphs" / name, self.path.parent / f"away-{name}"
        os.rename(place, away)
        os.symlink(self.evil / name, place)
        time.sleep(self.pause)
        os.replace(away, place)
        self.rest()

    def directory(self, name: str) -> None:
        """Another directory, or a link to one, takes the place of the graphs."""
        place, away = self.path / "graphs", self.path.parent / "away"
        os.rename(place, away)
        os.symlink(self.evil, place)
        time.sleep(self.pause)
        os.unlink(place)
        os.rename(away, place)
        self.rest()


def attack(folder: Path, loads: int, pause: float = 0.004) -> Counter[str]:
    """Load a victim in ``folder`` so many times beside the swapping thread."""
    path = victim.make(folder / "bundle").path
    wanted = victim.answers(path)
    counts: Counter[str] = Counter()
    swapper = Swapper(path, pause)
    swapper.start()
    try:
        for _ in range(loads):
            try:
                counts["right answer" if victim.equal(wanted, victim.answers(path)) else WRONG] += 1
            except VlatoolError as error:
                counts[f"refused: {type(error).__name__}"] += 1
    finally:
        swapper.over.set()
        swapper.join()
    counts["(swaps)"] = swapper.swaps
    return counts


def main() -> int:
    """Read the options, attack, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--loads", type=int, default=1000)
    parser.add_argument("--pause", type=float, default=0.004)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    folder = Path(tempfile.mkdtemp(prefix="swaps-"))
    started = time.monotonic()
    try:
        counts = attack(folder, options.loads, options.pause)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"{options.loads} loads in {time.monotonic() - started:.0f} s")
    for name in sorted({*counts, WRONG}):
        print(f"{counts[name]:>10}  {name}")
    return int(counts[WRONG] > 0)


if __name__ == "__main__":
    sys.exit(main())
