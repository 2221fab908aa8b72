"""Bundles of a few operators, made on this host, for what deadlines and updates do on another processor."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

TESTS = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(TESTS), str(TESTS / "runtime")]

from _slots import bundle_of  # noqa: E402
from _written import ENDLESS, X, written  # noqa: E402

from vlatool.bundle.bundle import Bundle, seal  # noqa: E402
from vlatool.bundle.spec import TensorSpec  # noqa: E402
from vlatool.stage.finish import save_npz  # noqa: E402

LOOP = ENDLESS.replace("(float[1,2] x) =>", "(float[1,2] x, int64[1] trips) =>").replace(
    "int64 trips = {4611686018427387904}, ", ""
)


def make_all(folder: Path) -> Path:
    """Write a graph whose input says how long it loops, two policies, and one whose golden action is another's."""
    shutil.rmtree(folder, ignore_errors=True)
    written(folder / "endless", LOOP, inputs=(X, TensorSpec("trips", (1,), "int64")))
    for value, name in enumerate(("one", "two", "wrong"), 1):
        bundle_of(folder / name, value, f"{value}.0.0")
    stored = {"in.x": np.ones((1, 2), np.float32), "out.y": np.full((1, 1, 3, 2), 7, np.float32)}
    save_npz(folder / "wrong/golden/golden.npz", stored)
    seal(folder / "wrong", Bundle.open_lazily(folder / "wrong").manifest)
    return folder
