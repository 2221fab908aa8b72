"""Damage to files of telemetry and of recorded runs: no record that is not as it was written is read, nothing hangs.

    python tests/validation/stack/damaged_files.py --tries 1000000

Damage: a bit flipped, a part cut out, repeated, zeroed, reversed or replaced by noise; and files cut off. Prints how
many were refused, how many ended early, and the slowest read.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "runtime" / "telemetry"))
from _records import altered, record

from vlatool.errors import DataError
from vlatool.runtime.telemetry.json_lines import JsonLines, read_lines
from vlatool.runtime.telemetry.run_file import Frame, FrameKind, RunWriter, read_run


def lines_file(folder: Path) -> Path:
    """Write lines of JSON."""
    sink = JsonLines(folder / "run.jsonl")
    for step in range(8):
        sink(record(step))
    sink.close()
    return sink.path


def run_file(folder: Path) -> Path:
    """Write a recorded run."""
    writer = RunWriter(folder / "run")
    writer.append(Frame(FrameKind.HEADER, {"policy": "p"}, {}))
    for step in range(6):
        arrays = {"seen.q": np.arange(7, dtype=np.float32), "action": np.full(7, step, np.float32)}
        writer.append(Frame(FrameKind.TICK, {"step": step, "clock": [0.1 * step], "answers": []}, arrays))
    writer.append(Frame(FrameKind.END, {"omitted": 0}, {}))
    writer.close()
    return folder / "run"


def plain(value: Any) -> Any:
    """Return what is compared of a line or a frame."""
    if not isinstance(value, Frame):
        return value
    return value.kind, value.values, {name: (str(each.dtype), each.tobytes()) for name, each in value.arrays.items()}


def damage(path: Path, reader: Any, tries: int, random: np.random.Generator) -> Counter[str]:
    """Damage a file so many times; raises AssertionError when a record is read that was not written."""
    content, whole = path.read_bytes(), [plain(each) for each in reader(path)]
    found: Counter[str] = Counter()
    for _ in range(tries):
        cut = random.integers(8) == 0
        damaged = content[: random.integers(len(content))] if cut else altered(content, random)
        path.write_bytes(damaged)
        seen, begin, kind = [], time.monotonic(), "ended early"
        try:
            seen.extend(plain(each) for each in reader(path))
        except DataError:
            kind = "refused"
        assert seen == whole[: len(seen)], damaged
        found["unchanged" if len(seen) == len(whole) and kind != "refused" else kind] += 1
        found["slowest us"] = max(found["slowest us"], int((time.monotonic() - begin) * 1e6))
    return found


def trials(tries: int, seed: int) -> dict[str, Counter[str]]:
    """Return what became of damaged files of each kind."""
    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        return {
            "lines of JSON": damage(lines_file(Path(folder)), read_lines, tries // 2, random),
            "recorded runs": damage(run_file(Path(folder)), read_run, tries - tries // 2, random),
        }


def main() -> None:
    """Print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for name, found in trials(options.tries, options.seed).items():
        print(f"{name}: {', '.join(f'{kind} {count:,}' for kind, count in sorted(found.items()))}; none accepted wrong")


if __name__ == "__main__":
    main()
