"""The runtime on emulated 64-bit ARM: does every bundle load there, and answer what it answers here?

And the layers around a policy (controllers, envelope, deadline, updates, deployment through ssh, serving): the same?

Usage: python tests/validation/processors/arm64.py [--sources SOURCE ...] [--cores CORE ...] [--onnxruntime VERSION ...]
           [--newest] [--observations COUNT] [--stack PARTS] [--jobs COUNT] [-o out/processors]

Prints a table of agreement with this host, which computes the same observations from the same bundles. Exits 1 when a
row is above its limit, when a bundle does not load, and when one loads that ARM computes otherwise. Never a timing:
emulation is some 300 times slower. Where a registry does not answer, says so in one line and exits 0.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
from _asked import CRASHED, ROOT, Answer, ask
from _emulation import RUNTIME, EmulationError, Emulators, Unreachable
from _planted import plant
from _rungs import CPUINFO, model
from _stack_rows import stack_rows
from _variants import FLOAT, FOR_ARM, SAMPLES, Made, VariantError, make
from _verdicts import Difference, Row, difference, exit_code, summed_up, table

from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.stage.finish import MAX_ROUNDING

CORES = ("cortex-a76", "cortex-a72")
"""Raspberry Pi 5, and Raspberry Pi 4, which has no dot product."""
OLDEST = "1.23.2"
"""The oldest ONNX Runtime that vlatool takes, and the newest for Python 3.10."""
PLANTED = "planted"
PARTS = ("all", "controllers", "none")
PREPARATION = Path(__file__).with_name("preparation.py")
PIXEL = 1e-5
"""Largest difference of a normalised pixel: 600 times less than a step of 1/255 makes."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Fetch, make, ask, compare, and print."""
    given = parsed(arguments)
    cache = Emulators(given.output.resolve())
    try:
        cache.folder.mkdir(parents=True, exist_ok=True)
        fetch(cache, given.onnxruntime)
        rows = [row for source in given.sources for row in rows_of(source, given, cache)]
        if given.stack != "none":
            board = (given.cores[0], given.onnxruntime[-1])
            rows += stack_rows(board, *emulated(board, cache), cache, given.stack)
    except Unreachable as error:
        print(f"make arm64: skipped, nothing was tried: {error}")
        return 0
    except (EmulationError, VariantError) as error:
        print(f"make arm64: {error}", file=sys.stderr)
        return 1
    print("\n".join(table(("core", "onnxruntime", "policy"), rows)))
    host = model(CPUINFO.read_text())
    print(f"{summed_up(rows)}; the host: onnxruntime {OrtCpuSession.version()} on {host}")
    return exit_code(rows)


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--sources", nargs="*", default=SAMPLES, help="what vlatool export takes; none for the stack alone"
    )
    parser.add_argument("--cores", nargs="+", default=CORES, help="as QEMU calls them")
    parser.add_argument("--onnxruntime", nargs="+", default=(OLDEST, OrtCpuSession.version()), help="versions")
    parser.add_argument("--newest", action="store_true", help="only the version that this host runs")
    parser.add_argument("--observations", type=int, default=8, help="of each recording, spread evenly; 0: all")
    parser.add_argument("--stack", choices=PARTS, default=PARTS[0], help="what is tried of the layers around a policy")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="boards at the same time")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/processors"), help="cache, bundles and answers")
    given = parser.parse_args(arguments)
    if given.newest:
        given.onnxruntime = (OrtCpuSession.version(),)
    return given


def fetch(cache: Emulators, versions: Sequence[str]) -> None:
    """Fetch what is not in the cache: afterwards nothing is asked of a registry."""
    cache.folder.mkdir(parents=True, exist_ok=True)
    cache.qemu("aarch64")
    cache.board()
    cache.runtime()
    for version in versions:
        cache.wheels(version)


def rows_of(source: str, given: argparse.Namespace, cache: Emulators) -> list[Row]:
    """Return the rows of a policy."""
    name = Path(source).name
    made = make(source, FOR_ARM, cache.folder / "bundles" / name, given.observations)
    bundles = {**made.bundles, PLANTED: plant(made.bundles[FLOAT.name], cache.folder / "bundles" / name / PLANTED)}
    print(f"{name}: {made.chosen} of {made.recorded} recorded observations", flush=True)
    here = ask([sys.executable], bundles, made.observations, cache.folder / "answers" / name / "host")
    boards = list(product(given.cores, given.onnxruntime))
    with ThreadPoolExecutor(given.jobs) as pool:
        there = pool.map(lambda board: asked(*board, made, bundles, cache), boards)
    answers = zip(boards, there, strict=True)
    rows = unmade(made) + [row for board, each in answers for row in compared((*board, name), here, each)]
    return rows + prepared(boards[0], name, list(made.bundles.values()), cache)


def prepared(board: tuple[str, str], name: str, bundles: list[Path], cache: Emulators) -> list[Row]:
    """Return a row for what becomes of camera frames, and one for the identities of bundles: the same as here."""
    folder = cache.folder / "answers" / name
    here, there = folder / "prepared-here.npz", folder / "prepared-there.npz"
    python, path = emulated(board, cache)
    for words, file, more in (([sys.executable], here, {}), (python, there, path)):
        place = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **more}
        done = subprocess.run([*words, PREPARATION, "-o", file, *bundles], env=place, check=False, cwd=ROOT)
        if done.returncode:
            return [Row((*board, name), "camera frames", None, 0.0, CRASHED, note=f"left with {done.returncode}")]
    with np.load(here) as ours, np.load(there) as theirs:
        names = [each for each in ours.files if not each.startswith("identity")]
        apart = max(float(np.abs(ours[each] - theirs[each]).max()) for each in names)
        others = [each for each in ours.files if each not in names and str(ours[each]) != str(theirs[each])]
        frames = Row((*board, name), f"{len(names)} camera frames", Difference(apart, apart), PIXEL)
        differ = float(bool(others))
        return [frames, Row((*board, name), "identity", Difference(differ, differ), 0.0, note=", ".join(others))]


def asked(core: str, version: str, made: Made, bundles: dict[str, Path], cache: Emulators) -> dict[str, Answer]:
    """Ask every bundle on an emulated board."""
    python, path = emulated((core, version), cache)
    out = cache.folder / "answers" / made.name / f"{core}-{version}"

    def tell(line: str) -> None:
        print(f"{made.name} on {core}, onnxruntime {version}: {line.strip()}", flush=True)

    return ask(python, bundles, made.observations, out, variables=path, tell=tell)


def emulated(board: tuple[str, str], cache: Emulators) -> tuple[list[str], dict[str, str]]:
    """Return the words that start Python on an emulated board, and the variables that it needs."""
    core, version = board
    path = {"PYTHONPATH": f"{cache.wheels(version)}:{cache.folder / RUNTIME}"}
    return [*cache.emulated("aarch64", core), str(cache.python())], path


def unmade(made: Made) -> list[Row]:
    """Return a row for every bundle that could not be made."""
    refused = made.refused.items()
    return [Row(("host", "", made.name), name, None, 0.0, "not made", note=why) for name, why in refused]


def compared(where: tuple[str, ...], here: dict[str, Answer], there: dict[str, Answer]) -> list[Row]:
    """Return the rows of one emulated board."""
    limits = {PLANTED: MAX_ROUNDING, **{variant.name: variant.limit for variant in FOR_ARM}}
    rows = []
    for name, answer in there.items():
        wanted = here[name].actions
        if here[name].refused or wanted is None:
            rows.append(Row(where, name, None, limits[name], here[name].refused, note=here[name].why))
            continue
        found = None if answer.actions is None else difference(answer.actions, wanted)
        must = "refuse" if name == PLANTED else "load"
        limit = limits[name]
        rows.append(Row(where, name, found, limit, answer.refused, must=must, note=answer.why))
    return rows


if __name__ == "__main__":
    sys.exit(main())
