"""Confine a virtual environment to an instruction set: what runs in it believes that the processor has no more.

Usage: python tests/validation/processors/confine.py VENV SET
       python tests/validation/processors/confine.py --list
       python tests/validation/processors/confine.py --able SET

What runs in it runs at native speed. The libraries of the environment are changed for good, so take one that nothing
else needs. Features are hidden; AVX-VNNI alone is added, where the host has AVX512-VNNI. Run it again after packages
were installed: it changes what is new. Then the libraries are asked what they see. Exits 2 when it cannot be done, 1
when a library still sees a hidden feature.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Sequence
from pathlib import Path

from _cpuinfo import HOST, flags
from _sets import InstructionSet, RefusedError, listing, named

SAYS = "confine.py"


def main(arguments: Sequence[str] | None = None) -> int:
    """Confine, and say what was done."""
    given = parsed(arguments)
    try:
        has = flags(HOST.read_text())
        if given.list:
            print("\n".join(listing(has)))
        elif given.able:
            named(given.able, has)
        else:
            return confined(given.venv, named(given.set, has), has)
    except (RefusedError, OSError) as error:
        print(f"{SAYS}: {error}", file=sys.stderr)
        return 2
    return 0


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("venv", nargs="?", type=Path, metavar="VENV", help="a virtual environment, which is changed")
    parser.add_argument("set", nargs="?", metavar="SET", help="the set; --list lists them")
    parser.add_argument("--list", action="store_true", help="the sets that this host can be confined to")
    parser.add_argument("--able", metavar="SET", help="say nothing and exit 0 when this host can be confined to a set")
    given = parser.parse_args(arguments)
    if not (given.list or given.able) and given.set is None:
        parser.error("name an environment and a set, or --list")
    return given


def confined(venv: Path, target: InstructionSet, has: Collection[str]) -> int:
    """Confine an environment and ask its libraries what they see."""
    from _confined import UnconfinedError, check, confine, environment

    place = environment(venv)
    count = confine(place, target, has)
    try:
        seen = check(place, target)
    except UnconfinedError as error:
        print(f"{SAYS}: {venv} is not confined to {target.name}: {error}", file=sys.stderr)
        return 1
    print(f"{venv}: confined to {target.name} ({count} libraries changed); asked: {', '.join(seen)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
