"""A policy that keeps values is evaluated on what it does in whole episodes, whichever samples are counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from _recurrent import exported, recorded

from vlatool.evaluate.recorded import Recorded
from vlatool.stage.base import Context


@pytest.mark.parametrize(("episodes", "samples"), [(True, 10_000), (True, 7), (False, 10_000), (False, 7)])
def test_all_that_comes_before_a_sample_is_run(tmp_path: Path, episodes: bool, samples: int):
    bundle = exported(tmp_path / "delayed", "delayed", count=6, episodes=episodes)
    (row,) = Recorded(samples=samples).run(bundle, Context()).rows
    assert row.get("error_expert").value < 1e-6
    np.savez(tmp_path / "others.npz", **recorded(6, seed=1, episodes=episodes))
    (row,) = Recorded(samples=samples, data=tmp_path / "others.npz").run(bundle, Context()).rows
    assert row.get("error_expert").value < 1e-6
