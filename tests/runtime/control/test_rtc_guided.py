"""Real-time chunking with a graph that computes guided in-painting itself, against seams that are blended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _guided_flow import CHUNK, SIDE, by_autograd, guided_flow

from vlatool.runtime import Policy
from vlatool.runtime.control.rtc import DELAY, HORIZON, LEFT_OVER, RealTimeController
from vlatool.runtime.interface import Action

GUIDES = (LEFT_OVER, DELAY, HORIZON)


def opened(seed: int = 0) -> Policy:
    return Policy.open(guided_flow(), threads=1, seed=seed)


class Unguided:
    """The same policy as one that knows nothing of the chunk before, so that its seams are blended."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        inputs = tuple(tensor for tensor in policy.spec.inputs if tensor.name not in GUIDES)
        self.spec = replace(policy.spec, inputs=inputs)

    def infer(self, observation: Mapping[str, Any], *, noise: Any = None) -> Action:
        nothing = {LEFT_OVER: np.zeros((1, CHUNK, 2), np.float32), DELAY: np.array([0]), HORIZON: np.array([0])}
        return self.policy.infer({**observation, **nothing}, noise=noise)

    def reset(self, seed: int | None = None) -> None:
        self.policy.reset(seed)


def played(policy: Any, delay: int, steps: int = 240, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance from the path at each step, (steps, A), and which actions were the first of a chunk."""
    controller = RealTimeController(policy, delay=delay, **options)
    taken = [(controller.act({"t": [t]}), controller.fresh) for t in range(steps)]
    path = np.array([[np.sin(t / 10), np.cos(t / 10)] for t in range(steps)])
    return np.stack([action for action, _ in taken]) - path, np.array([fresh for _, fresh in taken])


@pytest.mark.parametrize(("delay", "horizon"), [(0, 0), (3, 8), (8, 8), (0, 16)])
def test_the_graph_computes_the_correction_that_autograd_does(delay: int, horizon: int):
    random = np.random.default_rng(delay)
    rest, noise = (random.standard_normal((1, CHUNK, 2)).astype(np.float32) for _ in range(2))
    seen = {"t": np.float32(7.5), LEFT_OVER: rest, DELAY: delay, HORIZON: horizon}
    given = {"t": [7.5], LEFT_OVER: rest, DELAY: np.array([delay]), HORIZON: np.array([horizon])}
    chunk = opened().infer(given, noise={"x": noise}).chunk
    np.testing.assert_allclose(chunk, by_autograd(seen, noise), atol=2e-4)
    plain = opened().infer({**given, HORIZON: np.array([0]), DELAY: np.array([0])}, noise={"x": noise}).chunk
    assert (np.abs(chunk - plain).max() > 0.05) == (horizon > 0), "it does something"


def test_without_guidance_each_draw_takes_a_side():
    policy, sides = Unguided(opened()), []
    for _ in range(30):
        action = policy.infer({"t": [0.0]}).chunk
        away = action - [[np.sin(place / 10), np.cos(place / 10)] for place in range(CHUNK)]
        assert (np.abs(np.abs(away) - SIDE) < 6 * 0.05).all()
        sides.append(np.sign(away.mean()))
    assert 8 <= sides.count(1) <= 22


@pytest.mark.parametrize("delay", [1, 3, 6])
def test_a_guided_graph_keeps_its_side_where_blending_changes_it(delay: int):
    """Blending leads through what lies between the sides, where the policy would never act."""
    (guided, seams), (blended, other_seams) = played(opened(), delay), played(Unguided(opened()), delay)
    changes = [np.abs(np.diff(away, axis=0)) for away in (guided, blended)]
    sides = [int((np.diff(np.sign(away.mean(-1))) != 0).sum()) for away in (guided, blended)]
    assert seams.sum() == other_seams.sum() >= 40
    assert sides[0] <= 4
    assert sides[1] >= 15
    assert changes[0][seams[1:]].mean() < 0.95 * changes[1][seams[1:]].mean(), "the jump at a seam"
    assert changes[0].mean() < 0.4 * changes[1].mean(), "and the change from step to step"
    assert np.median(changes[0][seams[1:]]) < 1.5 * np.median(changes[0][~seams[1:]]), "no seam is to be seen"
    beside = [np.abs(np.abs(away) - SIDE).mean() for away in (guided, blended)]
    assert beside[0] < 0.03 < 0.1 < beside[1]


def test_without_blending_and_guidance_each_other_side_is_a_jump():
    jumps, seams = played(Unguided(opened()), 3, blend=0)
    changes = np.abs(np.diff(jumps, axis=0))
    assert changes[seams[1:]].mean() > 10 * changes[~seams[1:]].mean()
