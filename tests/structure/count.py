"""Count what the structure of vlatool is held to: modules at the root, private imports, circles, lines.

    python tests/structure/count.py
    python tests/structure/count.py --of OTHER_CHECKOUT

Prints one line for each count. Nothing of vlatool is imported.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from imports import ROOT, circles, modules, private_imports


def counts(root: Path = ROOT) -> dict[str, int]:
    """Return what is counted -> how many there are."""
    known = modules(root)
    return {
        "modules at the root": sum(name.count(".") == 1 and path.name != "__init__.py" for name, path in known.items()),
        "private imports across packages": len(private_imports(root)),
        "circles of modules": len(circles(root)),
        "modules": len(known),
        "lines": sum(path.read_bytes().count(b"\n") for path in known.values()),
        "longest module": max(path.read_bytes().count(b"\n") for path in known.values()),
    }


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", type=Path, default=ROOT, help="another checkout")
    for what, number in counts(parser.parse_args().of).items():
        print(f"{what:34}{number:7}")


if __name__ == "__main__":
    main()
