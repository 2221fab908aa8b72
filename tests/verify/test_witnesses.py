"""Commands that are indices: told by how images change with each, and by inputs that repeat them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import Recording, build_recording
from vlatool.verify._other_episodes import Judge, Outcome
from vlatool.verify._reading import names_of
from vlatool.verify._witnesses import Dynamics, Repeat
from vlatool.verify.log import MAX_WIDTH

Arrays = dict[str, Any]
STEPS, SIZE = 12, 24
SPEC = PolicySpec(
    inputs=(TensorSpec(name="image", shape=(1, SIZE, SIZE, 3), dtype="uint8", unit="rgb"),
            TensorSpec(name="before", shape=(1, 2), dtype="int64", unit="1")),
    outputs=(TensorSpec(name="logits", kind="discrete", shape=(1, 3), labels=("left", "right", "forward")),),
    control_hz=5.0,
    chunk=1,
)  # fmt: skip


def episode(seed: int) -> Arrays:
    """A lamp that goes left, right, or up with the command, one step later; the input repeats two commands."""
    random = np.random.default_rng(seed)
    commands = random.integers(3, size=STEPS)
    steps = np.array([[0, -3], [0, 3], [-3, 0]])[commands]
    place = (
        np.array([12, 12])
        + random.integers(-4, 5, 2)
        + np.concatenate([np.zeros((1, 2), int), np.cumsum(steps, axis=0)[:-1]])
    )
    rows, columns = np.mgrid[:SIZE, :SIZE]
    away = (rows - place[:, :1, None] % SIZE) ** 2 + (columns - place[:, 1:, None] % SIZE) ** 2
    image = 30 + 200 * np.exp(-away / 30)[..., None] * [1, 0.5, 0.2] + random.normal(0, 2, (STEPS, SIZE, SIZE, 3))
    before = np.stack([np.append([3] * ago, commands[:-ago]) for ago in (2, 1)], axis=1)
    return {"image": np.clip(image, 0, 255).astype(np.uint8), "before": before, "action": commands}


def joined(seeds: range) -> Arrays:
    episodes = [episode(seed) for seed in seeds]
    arrays = {name: np.concatenate([each[name] for each in episodes]) for name in episodes[0]}
    return {**arrays, "episode": np.repeat(np.arange(len(episodes)), STEPS)}


def recording(arrays: Arrays) -> Recording:
    return build_recording(Path("log.npz"), arrays, SPEC, {})


@pytest.fixture(scope="module")
def judge() -> Judge:
    right = recording(joined(range(40)))
    return Judge.of(SPEC, names_of(SPEC, right, right, MAX_WIDTH), right)


@pytest.fixture
def judged(judge: Judge) -> Callable[[Arrays], Outcome]:
    return lambda arrays: judge.explain(recording(arrays), {})


def log() -> Arrays:
    return joined(range(100, 108))


def late(values: np.ndarray, steps: int) -> np.ndarray:
    rows = np.arange(len(values))
    return values[np.maximum(rows - steps, rows - rows % STEPS)]


WRONG = {
    "two commands": ("action", lambda v: np.array([1, 0, 2])[v], "logits", "permuted",
                     "left holds right, right holds left"),
    "three commands": ("action", lambda v: np.array([1, 2, 0])[v], "logits", "permuted",
                       "left holds forward, right holds left, forward holds right"),
    "commands late": ("action", lambda v: late(v, 1), "logits", "delayed", "1 control step late"),
    "image late": ("image", lambda v: late(v, 1), "image", "delayed", "1 control step late"),
    "image later": ("image", lambda v: late(v, 2), "image", "delayed", "2 control steps late"),
    "input late": ("before", lambda v: late(v, 1), "before", "delayed", "1 control step late"),
    "input of other numbers": ("before", lambda v: np.array([1, 0, 2, 3])[v], "before", "permuted",
                               "0 holds 1, 1 holds 0"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wired_wrong_is_named_by_what_follows_the_commands(judged, case):
    name, change, signal, kind, words = WRONG[case]
    arrays = log()
    found = judged({**arrays, name: change(arrays[name])}).explanations
    assert [(each.signal, each.kind, each.where) for each in found] == [(signal, kind, words)]


def test_a_right_log_is_right(judged):
    assert judged(log()).explanations == ()


def test_what_repeats_no_command_and_what_never_changes_is_no_witness(judge):
    series = judge.series
    commands = series.values["logits"]
    random = np.random.default_rng(0).permutation(commands)
    other = series.with_signals(("before",), lambda _: random)
    assert Repeat.of("before", series, "logits").ago == 1
    assert Repeat.of("before", other, "logits") is None
    one = series.with_signals(("logits",), lambda values: np.eye(3)[np.zeros(len(values), int)])
    assert Dynamics.of("image", one, "logits") is None


def test_a_command_that_the_reference_never_has_counts_for_nothing(judge):
    dynamics = Dynamics.of("image", judge.series.part(judge.series.values["logits"][:, 2] < 2), "logits")
    seldom = judge.series.with_signals(("logits",), lambda values: values * [1, 1, 0])
    rare = Dynamics.of("image", seldom, "logits")
    scores, told = rare.scores(judge.series)
    assert dynamics.known.all()
    assert rare.known.tolist() == [True, True, False]
    assert np.all(scores[:, 2] == 0)
    assert told.sum() == 40 * (STEPS - 1)
