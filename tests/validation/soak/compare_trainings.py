"""Print how far two trained bundles are from each other: losses of the steps, and weights.

    python tests/validation/soak/compare_trainings.py ONE OTHER

Printed are the largest relative difference of a step's loss, and the relative L2 difference of all weights.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file


def main() -> None:
    """Compare two bundles."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", type=Path, nargs=2, metavar="BUNDLE")
    bundles = parser.parse_args().bundles
    one, other = (np.array(json.loads((each / "module/training.json").read_text())["losses"]) for each in bundles)
    tensors = [load_file(each / "module/main.safetensors") for each in bundles]
    first, second = (np.concatenate([named[name].ravel() for name in sorted(named)]) for named in tensors)
    losses, weights = np.abs(other / one - 1).max(), np.linalg.norm(second - first) / np.linalg.norm(first)
    print(f"losses {losses:.1e}, weights {weights:.1e}")


if __name__ == "__main__":
    main()
