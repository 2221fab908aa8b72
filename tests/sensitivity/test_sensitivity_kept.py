"""What each layer costs is measured with what the policy keeps of the observations before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from _recurrent import LENGTH, exported, recorded

from vlatool.data import recorded_observations
from vlatool.explain._operators import raw_actions
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.sensitivity.layers import Switchboard, ranges_of
from vlatool.stage.base import Context

pytestmark = pytest.mark.filterwarnings("ignore:.*calibration samples:UserWarning")


def test_each_run_begins_with_what_was_kept_before_it(tmp_path: Path):
    bundle = exported(tmp_path / "sum", "sum", count=4)
    np.savez(tmp_path / "others.npz", **recorded(3, seed=5))
    observations = recorded_observations(bundle, 3 * LENGTH, tmp_path / "others.npz")
    policy, wanted = load(bundle.path, threads=1), []
    for number, observation in enumerate(observations):
        if number % LENGTH == 0:
            policy.reset()
        wanted.append(policy.infer(observation).outputs["action"])
    chosen = slice(5, None, 7)
    np.testing.assert_allclose(raw_actions(policy, observations[chosen]), wanted[chosen], atol=1e-6)
    seen = []

    class Seeing(Switchboard):
        def run(self, places, observation):
            seen.append(super().run((), observation).outputs["action"])
            return super().run(places, observation)

    stage = StaticInt8()
    with Seeing(bundle, stage, ranges_of(bundle, stage, Context())) as board:
        (layer,) = board.errors([tuple(board.shares)], observations[chosen], Context())
    np.testing.assert_allclose(seen, wanted[chosen], atol=1e-6)
    assert layer.error > 1e-4
