"""Bundles made under each instruction set and loaded under each other: do they act as promised, or are they refused?

Usage: python tests/validation/processors/sets_table.py [--sources SOURCE ...] [--sets SET ...] [--variants NAME ...]
           [--observations COUNT] [--names] [-o out/confined]

Needs a confined environment for each set, out/confined/SET/venv: ``make sets`` makes them. Each bundle is compared with
what its graphs say, computed operator by operator by ONNX Runtime on this host. Exits 1 when actions are further away
than the limit of the variant and ``load`` did not refuse the bundle there. Never a timing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from _asked import Answer, ask
from _confined import Environment, UnconfinedError, check
from _cpuinfo import HOST, flags
from _rungs import model
from _sets import SETS, InstructionSet, RefusedError, distinct, named
from _variants import BOTH, FOR_X86, ROOT, SAMPLES, Variant
from _verdicts import Row, difference, exit_code, summed_up, table
from ladder import reference, unmade

from vlatool.runtime.arithmetic import SATURATING
from vlatool.runtime.engines import reference as as_written

HERE = "host"
FLOW = "sample_models/vla-flow"
VARIANTS = ("float32", "dynamic-int8", "ort uint8", "ort int8", "openvino", "openvino uint8")
"""What ``vlatool`` makes where it is not asked for something special."""
MAKES = Path(__file__).with_name("makes.py")
LOW = "avx2"
"""Below it are sets of old processors, tried where there are not two others."""


class TableError(Exception):
    """What the user is told instead of a traceback."""


@dataclass(frozen=True)
class Place:
    """Where bundles are made and loaded.

    Args:
        name: Of the set, or of this host as it is.
        python: The interpreter that is confined to it.
    """

    name: str
    python: Path


@dataclass(frozen=True)
class Bundles:
    """What was made of a policy in one place.

    Args:
        place: Where.
        paths: Variant -> bundle.
        refused: Variant -> why it could not be made there.
        observations: File with recorded observations.
        said: Variant -> what the graphs say to them.
    """

    place: Place
    paths: dict[str, Path]
    refused: dict[str, str]
    observations: Path
    said: dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Make, ask everywhere, compare, and print."""
    given = parsed(arguments)
    text = HOST.read_text()
    try:
        targets = chosen(given.sets, flags(text))
        if given.names:
            print("\n".join(each.name for each in targets))
            return 0
        if as_written().arithmetic() == SATURATING:
            raise TableError("int8 products saturate here, so there is nothing to compare bundles with")
        places = [Place(HERE, Path(sys.executable)), *(confined(each, given.output) for each in targets)]
        rows = [row for source in given.sources for row in rows_of(source, places, given)]
    except (TableError, RefusedError, OSError) as error:
        print(f"make sets: {error}", file=sys.stderr)
        return 2
    print("\n".join(table(("made", "loaded", "engine", "policy"), rows)))
    print(f"{summed_up(rows)}; the host: {model(text)}")
    return exit_code(rows)


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", nargs="+", default=(*SAMPLES, FLOW), help="what vlatool export takes")
    parser.add_argument("--sets", nargs="+", default=[], help="beside the host; all that hide something when left out")
    parser.add_argument("--variants", nargs="+", default=VARIANTS, choices=[each.name for each in FOR_X86])
    parser.add_argument("--observations", type=int, default=8, help="of each recording, spread evenly; 0: all")
    parser.add_argument("--names", action="store_true", help="print the sets that would be tried, and stop")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/confined"), help="environments and bundles")
    given = parser.parse_args(arguments)
    given.output = given.output.absolute()
    return given


def chosen(names: Sequence[str], has: frozenset[str]) -> list[InstructionSet]:
    """Return the sets to try beside the host: those that were named, or AVX2 and above, or the next below.

    Raises:
        RefusedError: when this host cannot be confined to one that was named.
    """
    if names:
        return [named(name, has) for name in names]
    able = distinct(has)
    order = [each.name for each in SETS]
    usual = [each for each in able if order.index(each.name) >= order.index(LOW)]
    return usual or list(able[-1:])


def confined(target: InstructionSet, folder: Path) -> Place:
    """Return the environment of a set, whose libraries are asked what they see.

    Raises:
        TableError: when there is none, or it is not confined.
    """
    place = Environment(folder / target.name / "venv")
    if not place.python.exists():
        raise TableError(f"there is no {place.root}: make confined SET={target.name}")
    try:
        check(place, target)
    except UnconfinedError as error:
        raise TableError(f"{place.root} is not confined to {target.name}: {error}") from error
    return Place(target.name, place.python)


def rows_of(source: str, places: Sequence[Place], given: argparse.Namespace) -> Iterator[Row]:
    """Yield the rows of a policy: each place's bundles in each place and engine."""
    name = Path(source).name
    variants = {each.name: each for each in FOR_X86 if each.name in given.variants}
    for maker in places:
        out = given.output / "made" / maker.name / name
        bundles = made(source, maker, list(variants), given.observations, out)
        for why in bundles.refused:
            yield unmade((maker.name, "-", "-", name), variants[why], bundles.refused[why])
        for loader, engine in product(places, BOTH):
            print(f"{name}: made under {maker.name}, loaded under {loader.name} in {engine}", flush=True)
            answers = asked(
                bundles, loader, engine, variants, out.parent / "answers" / f"{name}-{loader.name}-{engine}"
            )
            where = (maker.name, loader.name, engine, name)
            yield from (row(where, variants[each], answer, bundles.said[each]) for each, answer in answers.items())


def made(source: str, place: Place, variants: Sequence[str], count: int, out: Path) -> Bundles:
    """Make the bundles of a policy in a place.

    Raises:
        TableError: when the policy cannot be exported there.
    """
    print(f"{Path(source).name}: making bundles under {place.name}", flush=True)
    shutil.rmtree(out, ignore_errors=True)
    words = [str(place.python), str(MAKES), source, "-o", str(out), "--observations", str(count)]
    done = subprocess.run(
        [*words, "--variants", *variants], cwd=ROOT, env=variables(out), capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise TableError(f"{source} under {place.name}: {last}")
    told = json.loads(done.stdout.splitlines()[-1])
    paths = {name: Path(path) for name, path in told["bundles"].items()}
    observations = Path(told["observations"])
    said = {name: reference(path, observations) for name, path in paths.items()}
    return Bundles(place, paths, told["refused"], observations, said)


def variables(out: Path) -> dict[str, str]:
    """Return an environment with a cache of this place's own: what another made is not of this set."""
    return {**os.environ, "VLATOOL_CACHE": str(out.parent / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}


def asked(
    bundles: Bundles, loader: Place, engine: str, variants: Mapping[str, Variant], out: Path
) -> dict[str, Answer]:
    """Load the bundles in a place and an engine, and let them act."""
    paths = {
        name: path for name, path in bundles.paths.items() if name in variants and engine in variants[name].engines
    }
    return ask([str(loader.python)], paths, bundles.observations, out, engine, tell=lambda line: None)


def row(where: tuple[str, ...], variant: Variant, answer: Answer, said: Any) -> Row:
    """Return one row: right, refused for what it computes, or wrong."""
    found = None if answer.actions is None else difference(answer.actions, said)
    note = re.sub(r"^/\S+ ", "", answer.why)  # the path would take the whole cell
    return Row(where, variant.name, found, variant.limit, answer.refused, must="tell", note=note)


if __name__ == "__main__":
    sys.exit(main())
