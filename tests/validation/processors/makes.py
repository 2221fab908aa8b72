"""Make the bundles of a policy with the Python that runs this: one that is confined makes those of its set.

Usage: python tests/validation/processors/makes.py SOURCE -o DIRECTORY [--variants NAME ...] [--observations COUNT]

Prints one line of JSON: which bundles there are, which could not be made and why, and the recorded observations. A
bundle that was written with a finding, since it computes something else here, is there as well: ``load`` has to refuse
it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from _variants import FOR_X86, VariantError, folder, make

from vlatool.bundle.bundle import MANIFEST


def main(arguments: Sequence[str] | None = None) -> int:
    """Make them, and say what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--variants", nargs="+", default=[each.name for each in FOR_X86])
    parser.add_argument("--observations", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args(arguments)
    variants = [each for each in FOR_X86 if each.name in given.variants]
    if given.output.exists() and any(given.output.iterdir()):
        print(f"{given.output} is not empty: what it holds would pass for what this run made", file=sys.stderr)
        return 1
    try:
        made = make(given.source, variants, given.output, given.observations)
    except VariantError as error:
        print(error, file=sys.stderr)
        return 1
    places = {each.name: given.output / folder(each) for each in variants}
    bundles = {name: str(path) for name, path in places.items() if (path / MANIFEST).is_file()}
    refused = {name: why for name, why in made.refused.items() if name not in bundles}
    print(json.dumps({"bundles": bundles, "refused": refused, "observations": str(made.observations)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
