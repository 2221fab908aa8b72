"""Every layout on every engine and instruction set that this host can be restricted to: are the numbers right there?

Usage: python tests/validation/processors/ladder.py [--sources SOURCE ...] [--observations COUNT] [--emulated COUNT]
           [-o out/processors]

Each bundle is held against what its graphs say, computed operator by operator by ONNX Runtime on this host. Exits 1
when a difference is above its limit and neither does ``load`` refuse the bundle there, nor does ``vlatool doctor`` warn
about its arithmetic. An instruction set that this host does not have is named, and not tried. Never a timing.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _asked import Answer, ask
from _emulation import EmulationError, Emulators, Unreachable
from _rungs import CPUINFO, RUNGS, Rung, flags, model
from _variants import FOR_X86, SAMPLES, Made, Variant, VariantError, make
from _verdicts import Row, difference, exit_code, summed_up, table
from answers import actions

from vlatool.bundle.bundle import Bundle
from vlatool.machine.host import MAX_CPU_ISA, architecture
from vlatool.runtime.arithmetic import SATURATING, is_int8
from vlatool.runtime.engines import reference as as_written
from vlatool.stage.finish import reference_policy

X86 = "x86_64"
"""What can be emulated: QEMU runs the host's own Python on another processor."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Make, ask on every rung, compare, and print."""
    given = parsed(arguments)
    os.environ.pop(MAX_CPU_ISA, None)
    if as_written().arithmetic() == SATURATING:
        print("make ladder: int8 products saturate here, so there is nothing to hold bundles against", file=sys.stderr)
        return 1
    text = CPUINFO.read_text()
    cache = Emulators(given.output.resolve())
    rungs = tried(flags(text), cache)
    try:
        rows = [row for source in given.sources for row in rows_of(source, given, cache, rungs)]
    except VariantError as error:
        print(f"make ladder: {error}", file=sys.stderr)
        return 1
    print("\n".join(table(("engine", "instruction set", "policy"), rows)))
    print(f"{summed_up(rows)}; the host: {model(text)}")
    return exit_code(rows)


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", nargs="+", default=SAMPLES, help="what vlatool export takes")
    parser.add_argument("--observations", type=int, default=8, help="of each recording, spread evenly; 0: all")
    parser.add_argument("--emulated", type=int, default=2, help="how many of those in QEMU, which is slow")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/processors"), help="cache, bundles and answers")
    return parser.parse_args(arguments)


def tried(found: frozenset[str], cache: Emulators) -> dict[Rung, str]:
    """Return rung -> why it is not tried; an empty text where it is.

    Raises:
        SystemExit: when QEMU cannot be fetched for another reason than a mirror that does not answer.
    """
    rungs = {}
    for rung in RUNGS:
        lacks = rung.lacking(found)
        rungs[rung] = f"this host lacks {', '.join(lacks)}" if lacks else ""
        if rung.cpu and architecture() != X86:
            rungs[rung] = f"this host is {architecture()}"
        try:
            if rung.cpu and not rungs[rung]:
                cache.folder.mkdir(parents=True, exist_ok=True)
                cache.qemu(X86)
        except Unreachable as error:
            rungs[rung] = str(error)
        except EmulationError as error:
            raise SystemExit(f"make ladder: {error}") from error
    return rungs


def rows_of(source: str, given: argparse.Namespace, cache: Emulators, rungs: Mapping[Rung, str]) -> list[Row]:
    """Return the rows of a policy."""
    name = Path(source).name
    made = make(source, FOR_X86, cache.folder / "ladder" / name, given.observations)
    print(f"{name}: {made.chosen} of {made.recorded} recorded observations", flush=True)
    said = {variant: reference(path, made.observations) for variant, path in made.bundles.items()}
    rows = []
    for rung, skipped in rungs.items():
        if skipped:
            rows.append(Row((rung.engine, rung.name, name), "all", None, 0.0, skipped=skipped))
            continue
        print(f"{name} in {rung.engine}, {rung.name}", flush=True)
        rows += climbed(rung, made, said, cache, given.emulated)
    return rows


def reference(bundle: Path, observations: Path) -> Any:
    """Return what the graphs of a bundle say to observations, (N, ...)."""
    with np.load(observations) as stored:
        return actions(reference_policy(Bundle.open(bundle)), {name: stored[name] for name in stored.files})


def climbed(rung: Rung, made: Made, said: Mapping[str, Any], cache: Emulators, emulated: int) -> list[Row]:
    """Return the rows of a policy on a rung."""
    variants = {each.name: each for each in FOR_X86 if rung.engine in each.engines}
    bundles = {name: path for name, path in made.bundles.items() if name in variants}
    python, observations = [sys.executable], made.observations
    if rung.cpu:
        python = [*cache.emulated(X86, rung.cpu), sys.executable]
        observations = some_of(made.observations, emulated)
    out = cache.folder / "answers" / made.name / f"{rung.engine}-{rung.isa or rung.cpu or 'host'}"
    found = ask(python, bundles, observations, out, rung.engine, rung.variables)
    where = (rung.engine, rung.name, made.name)
    rows = [row(where, variants[name], answer, said[name], bundles[name]) for name, answer in found.items()]
    return rows + [unmade(where, variants[name], why) for name, why in made.refused.items() if name in variants]


def unmade(where: tuple[str, ...], variant: Variant, why: str) -> Row:
    """Return the row of a bundle that could not be made: no fault where the processor may lack what it needs."""
    if variant.optional:
        return Row(where, variant.name, None, variant.limit, skipped=f"not made: {why}")
    return Row(where, variant.name, None, variant.limit, "not made", note=why)


def row(where: tuple[str, ...], variant: Variant, answer: Answer, said: Any, bundle: Path) -> Row:
    """Return one row: how far a bundle is from what its graphs say, and who says so before it moves a robot."""
    found = None if answer.actions is None else difference(answer.actions, said[: len(answer.actions)])
    saturates = answer.arithmetic == SATURATING and is_int8(Bundle.open_lazily(bundle).manifest)
    warned = "doctor: int8 products saturate" if saturates else ""
    return Row(where, variant.name, found, variant.limit, answer.refused, warned, "tell", answer.why)


def some_of(observations: Path, count: int) -> Path:
    """Write the first observations of a file beside it, and return where."""
    target = observations.with_name(f"first-{count}.npz")
    with np.load(observations) as stored:
        np.savez(target, **{name: stored[name][:count] for name in stored.files})
    return target


if __name__ == "__main__":
    sys.exit(main())
