"""What the runtime makes of camera frames on the processor that runs this, and who a policy is there: numpy alone.

Usage: python preparation.py -o FILE.npz BUNDLE...

Writes an array for each library and filter that the runtime follows, and the identity of each bundle.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.image import FILTERS, LIBRARIES, Image, ImageStep
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import SpecError
from vlatool.runtime.identity import policy_identity
from vlatool.runtime.image import FrameEncoder

FRAMES = (("bgr", (97, 131, 3)), ("rgba", (48, 40, 4)), ("grey", (60, 80)))
TENSOR = TensorSpec("frame", (1, 3, 56, 56), "float32")
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundles", nargs="*", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    given.output.parent.mkdir(parents=True, exist_ok=True)
    identities = {f"identity {path.name}": np.array(policy_identity(Bundle.open(path))) for path in given.bundles}
    np.savez(given.output, **dict(prepared()), **identities)


def prepared() -> Iterator[tuple[str, Any]]:
    """Yield a name, and what becomes of a frame: each library, filter and order of channels."""
    random = np.random.default_rng(0)
    for (order, shape), like, kind in itertools.product(FRAMES, LIBRARIES, FILTERS):
        frame = random.integers(0, 256, shape, np.uint8)
        pad = ImageStep("pad", (56, 56), value=(114.0,))
        for antialias in (False, True):
            steps = (ImageStep("resize", (56, 56), filter=kind, fit="contain", antialias=antialias), pad)
            try:
                image = Image(order, like=like, steps=steps, range=(0.0, 1.0), mean=MEAN, std=STD)
                encode = FrameEncoder(TENSOR, image)
            except SpecError:  # not every library has every filter, and only torch chooses to antialias
                continue
            yield f"{order} {like} {kind}{' antialiased' if antialias else ''}", encode(frame)


if __name__ == "__main__":
    main()
