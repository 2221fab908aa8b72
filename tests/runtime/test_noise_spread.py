"""How much a chunk depends on noise: measured beside the policy, which stays as it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _two_systems import observations, two_systems
from _written import written

from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.runtime import load
from vlatool.runtime.noise_spread import LOOK_PERIOD
from vlatool.runtime.stack import build_stack

LABELS = ("x", "z")
NOISY = """g (float[1,2] x, float[1,4,2] n, float[1,2] h) => (float[1,4,2] y, float[1,2] m)
    <int64[1] one = {1}> {
        m = Add(h, x)  far = Unsqueeze(m, one)  scaled = Mul(n, far)  y = Add(far, scaled) }"""
"""The noise counts as much as the sum of what was seen."""


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    step = ProgramStep(
        "main", {"x": "x", "n": "n", "h": "h"}, {"y": "y", "m": "h"}, keep={"h": {"shape": [1, 2]}},
        noise={"n": {"shape": [1, 4, 2], "distribution": "normal"}},
    )  # fmt: skip
    pose, action = TensorSpec("x", (1, 2), labels=LABELS), TensorSpec("y", (1, 4, 2), labels=LABELS, mode="delta")
    folder = tmp_path_factory.mktemp("spread") / "bundle"
    return written(folder, NOISY, (pose,), (action,), (step,), chunk=4).path


def acted(bundle: Path, *controllers: str, **more: Any) -> tuple[list[Any], list[float]]:
    stack = build_stack(load(bundle, threads=1, seed=3), controllers=controllers, **more)
    actions, seen = [], []
    for _ in range(2 * LOOK_PERIOD):
        actions.append(stack.act({"x": [0.01, 0.01]}).tolist())
        seen.append(getattr(stack.controller, "scores", {}).get("spread"))
    stack.close()
    return actions, [each for each in seen if each is not None]


@pytest.mark.parametrize("more", [{}, {"deadline_ms": 90.0}], ids=["at once", "deadline"])
def test_the_policy_acts_as_without_it(bundle: Path, more: dict[str, Any]):
    plain, _ = acted(bundle)
    watched, scores = acted(bundle, "anomaly:spread=5", **more)
    assert watched == plain
    assert len(scores) == 1, "every twentieth step that plays a chunk"
    assert 0.005 < scores[0] < 1.0


def test_a_policy_of_two_systems_acts_as_without_it_too():
    episode = observations(6 * LOOK_PERIOD)
    acts, found = [], []
    for controllers in ([], ["anomaly:spread=5"]):
        named = ["dual_rate:every=3", "chunked:execute=4", *controllers]
        stack: Any = build_stack(load(two_systems().path, threads=1, seed=3), controllers=named)
        acts.append([stack.act(seen).tolist() for seen in episode])
        spread = getattr(stack.controller, "_spread", None)
        found.append(spread and spread.measure(episode[0], (1, 2)))
        stack.close()
    assert acts[0] == acts[1]
    assert found[1] > 0.01


def test_a_policy_without_noise_has_none(tmp_path: Path):
    pose, action = TensorSpec("x", (1, 2)), TensorSpec("y", (1, 2), labels=LABELS, mode="delta")
    path = written(tmp_path / "b", "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", (pose,), (action,)).path
    assert acted(path, "anomaly:spread=5")[1] == []


def test_a_look_that_comes_too_late_says_nothing_and_leaves_the_policy_as_it_was(bundle: Path):
    stack: Any = build_stack(load(bundle, threads=1, seed=3), controllers=["anomaly:spread=5"], deadline_ms=90)
    spread = stack.controller._spread
    stack.act({"x": [0.01, 0.01]})
    before = stack.policy.snapshot
    (deadline,) = stack.deadlines
    deadline.started = -1e9
    assert spread.measure({"x": [0.01, 0.01]}, (1, 2)) is None
    np.testing.assert_equal(stack.policy.snapshot, before)
    deadline.started = None
    one, again, other = (spread.measure({"x": [0.01, 0.01]}, seeds) for seeds in ((1, 2), (1, 2), (3, 4)))
    assert one == again != other
    np.testing.assert_equal(stack.policy.snapshot, before)
    stack.close()
