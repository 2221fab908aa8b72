"""Every metric equals a plain loop over its formula, and does not change with what it must not depend on."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from vlatool.motion.measure import measure_episode, metrics
from vlatool.motion.track import Track
from vlatool.report import COUNT

TRAJECTORIES = 1000


def drawn(seed: int) -> Track:
    """A random track of 1 to 60 steps that has everything."""
    random = np.random.default_rng((seed, 17))
    steps, axes, joints = int(random.integers(1, 61)), int(random.integers(1, 4)), int(random.integers(1, 8))
    turn = random.integers(-1, 2, steps + 1) * math.pi / 2
    still = random.random(steps + 1) < 0.3
    moves = random.normal(size=(steps + 1, axes)) * ~still[:, None]
    return Track(
        hz=float(random.choice([5.0, 20.0, 80.0])), actions=random.normal(size=(steps, 4)),
        fresh=np.arange(steps) % int(random.integers(1, 6)) == 0, position=moves.cumsum(0),
        joints=random.normal(size=(steps + 1, joints)).cumsum(0), heading=turn.cumsum(),
        gripper=random.random(steps + 1), collision=random.random(steps) < 0.2, shortest=float(random.random() + 0.1),
        alike=(0, 1, 2), grip=3,
    )  # fmt: skip


def norm(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values))


def path(points: np.ndarray) -> float | None:
    if len(points) < 2:
        return None
    return sum(norm(list(points[t + 1] - points[t])) for t in range(len(points) - 1))


def jerk(points: np.ndarray, f: float) -> float | None:
    v = [[f * (b - a) for a, b in zip(points[t], points[t + 1], strict=True)] for t in range(len(points) - 1)]
    if len(v) < 3:
        return None
    bends = [
        sum((v[t + 1][d] - 2 * v[t][d] + v[t - 1][d]) ** 2 for d in range(len(v[t]))) for t in range(1, len(v) - 1)
    ]
    return f**4 / (len(v) - 2) * sum(bends)


def rate(track: Track) -> float | None:
    a = track.actions[:, :3]
    changes = [norm(list(a[t + 1] - a[t])) for t in range(len(a) - 1)]
    return sum(changes) / len(changes) if changes else None


def seam(track: Track) -> float | None:
    a = track.actions[:, :3]
    at = [norm(list(a[t] - a[t - 1])) for t in range(1, len(a)) if track.fresh[t]]
    inside = [norm(list(a[t] - a[t - 1])) for t in range(1, len(a)) if not track.fresh[t]]
    return (sum(at) / len(at)) / (sum(inside) / len(inside)) if at and inside else None


def turned(track: Track) -> list[float]:
    assert track.heading is not None
    change = [track.heading[t + 1] - track.heading[t] for t in range(len(track.heading) - 1)]
    return [math.atan2(math.sin(angle), math.cos(angle)) for angle in change]


def back(track: Track) -> float | None:
    assert track.position is not None
    turns = turned(track)
    moves = [[*(track.position[t + 1] - track.position[t]), turns[t]] for t in range(len(turns))]
    pairs = [sum(a * b for a, b in zip(moves[t], moves[t + 1], strict=True)) < 0 for t in range(len(moves) - 1)]
    return sum(pairs) / len(pairs) if pairs else None


def flips(track: Track) -> float:
    assert track.gripper is not None
    sides = [opening > 0.5 for opening in track.gripper if abs(opening - 0.5) > 0.1]
    return float(sum(a != b for a, b in itertools.pairwise(sides)))


def arc(track: Track) -> float | None:
    """SPARC as its authors publish it, written as sums."""
    assert track.position is not None
    if len(track.position) < 4:
        return None
    speed = [track.hz * norm(list(track.position[t + 1] - track.position[t])) for t in range(len(track.position) - 1)]
    if not any(speed):
        return None
    count = 2 ** (math.ceil(math.log2(len(speed))) + 4)
    size = [abs(sum(value * complex(math.cos(angle * t), -math.sin(angle * t)) for t, value in enumerate(speed)))
            for angle in (2 * math.pi * k / count for k in range(count // 2 + 1))]  # fmt: skip
    frequency = [k * track.hz / count for k in range(count // 2 + 1)]
    kept = [(f, m / max(size)) for f, m in zip(frequency, size, strict=True) if f <= 10.0]
    last = max(place for place, (_, m) in enumerate(kept) if m >= 0.05)
    kept = kept[: last + 1]
    width = kept[-1][0] - kept[0][0]
    return sum(math.hypot((b[0] - a[0]) / width, b[1] - a[1]) for a, b in itertools.pairwise(kept))


FORMULAS: dict[str, Callable[[Track], float | None]] = {
    "task_time": lambda track: len(track.actions) / track.hz,
    "path_length": lambda track: path(track.position),
    "joint_path": lambda track: path(track.joints),
    "jerk": lambda track: jerk(track.position, track.hz),
    "joint_jerk": lambda track: jerk(track.joints, track.hz),
    "action_rate": rate,
    "seam_jump": seam,
    "reversals": back,
    "gripper_flips": flips,
    "detour": lambda track: path(track.position) / track.shortest,
    "turns": lambda track: float(sum(
        abs(turn) > 1e-6 and not any(track.position[t + 1] - track.position[t]) for t, turn in enumerate(turned(track))
    )),
    "collisions": lambda track: float(sum(track.collision)),
}  # fmt: skip


def same(found: float | None, wanted: float | None) -> bool:
    return (found is None and wanted is None) or math.isclose(found, wanted, rel_tol=1e-9, abs_tol=1e-9)


def test_there_is_a_formula_for_every_metric():
    assert set(metrics()) == {*FORMULAS, "spectral_arc_length"}


@pytest.mark.parametrize("name", sorted(FORMULAS))
def test_a_metric_is_its_formula_on_random_trajectories(name: str):
    metric = metrics()[name]
    for seed in range(TRAJECTORIES):
        track = drawn(seed)
        assert same(metric.of(track), FORMULAS[name](track)), (seed, metric.of(track), FORMULAS[name](track))


def test_the_arc_length_is_its_formula_on_random_trajectories():
    metric = metrics()["spectral_arc_length"]
    for seed in range(120):  # a sum of cosines for each frequency takes its time
        track = drawn(seed)
        short = replace(track, position=track.position[:17])
        assert same(metric.of(short), arc(short)), (seed, metric.of(short), arc(short))


def smooth(count: int, hz: float) -> Track:
    """One reach along a curve (minimum jerk), seen ``count`` times in ``count / hz`` seconds."""
    t = np.linspace(0, 1, count)
    s = 10 * t**3 - 15 * t**4 + 6 * t**5
    position = np.column_stack([s, np.sin(s), 0.2 * s])
    return Track(hz, np.zeros((count - 1, 3)), np.ones(count - 1, bool), position=position, joints=position)


def test_units_of_length_scale_what_they_must():
    metres = smooth(161, 80.0)
    in_mm = measure_episode(replace(metres, position=1e3 * metres.position, joints=1e3 * metres.joints))
    for name, value in measure_episode(metres).items():
        power = {"path_length": 1, "joint_path": 1, "jerk": 2, "joint_jerk": 2}.get(name, 0)
        assert in_mm[name] == pytest.approx(value * 1e3**power, rel=1e-9), name


def test_a_rate_scales_time_and_jerk_and_nothing_else():
    slow, fast = measure_episode(smooth(161, 40.0)), measure_episode(smooth(161, 80.0))
    for name, value in slow.items():
        factor = {"task_time": 0.5, "jerk": 2.0**6, "joint_jerk": 2.0**6}.get(name, 1.0)
        if name != "spectral_arc_length":  # of frequencies up to 10 Hz: both are far below
            assert fast[name] == pytest.approx(value * factor, rel=1e-9), name


def test_the_same_motion_seen_twice_as_often_is_the_same_motion():
    once, twice = measure_episode(smooth(161, 80.0)), measure_episode(smooth(321, 160.0))
    for name in ("path_length", "joint_path", "jerk", "task_time", "spectral_arc_length"):
        assert twice[name] == pytest.approx(once[name], rel=0.03), name
    assert once["reversals"] == twice["reversals"] == 0.0


def test_a_smooth_reach_has_the_arc_length_of_the_literature_and_two_reaches_have_more():
    one = smooth(161, 80.0)
    back = np.concatenate([one.position, one.position[-1] + one.position[1:]])
    two = replace(one, position=back, actions=np.zeros((320, 3)), fresh=np.ones(320, bool))
    value = measure_episode(one)["spectral_arc_length"]
    assert 1.3 < value < 1.7
    assert measure_episode(two)["spectral_arc_length"] > value + 0.3


def test_a_place_and_a_direction_do_not_matter():
    track = drawn(5)
    random = np.random.default_rng(0)
    turn, _ = np.linalg.qr(random.normal(size=(track.position.shape[1],) * 2))
    moved = measure_episode(replace(track, position=track.position @ turn + 7.0, heading=track.heading + 2 * math.pi))
    for name, value in measure_episode(track).items():
        if name not in ("turns", "reversals"):  # rotations leave rounding where nothing moved
            assert moved[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name


def test_one_step_and_nothing_told_give_what_can_be_known():
    bare = Track(10.0, np.zeros((1, 2)), np.ones(1, bool), alike=(0, 1))
    assert measure_episode(bare) == {"task_time": 0.1}
    discrete = Track(5.0, np.zeros(4, int), np.ones(4, bool))
    assert measure_episode(discrete) == {"task_time": 0.8}
    still = Track(5.0, np.zeros((9, 2)), np.arange(9) % 3 == 0, position=np.zeros((10, 2)), alike=(0, 1), shortest=0.0)
    assert measure_episode(still) == {
        "task_time": 1.8,
        "path_length": 0.0,
        "jerk": 0.0,
        "action_rate": 0.0,
        "reversals": 0.0,
    }


@pytest.mark.parametrize(("name", "unit"), [
    ("gripper_flips", COUNT), ("turns", COUNT), ("collisions", COUNT), ("reversals", "1"), ("spectral_arc_length", ""),
])  # fmt: skip
def test_counts_and_numbers_without_a_dimension_are_no_shares(name: str, unit: str):
    assert metrics()[name].unit == unit
    assert ("share" in (type(metrics()[name]).__doc__ or "").lower()) is (unit == "1")
