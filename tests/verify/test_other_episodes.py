"""Logs of episodes that the reference does not hold: an arm that follows its commands, seen by a camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.data import Recording, build_recording
from vlatool.runtime.statistics import Normaliser
from vlatool.stage.base import Context
from vlatool.verify._distributions import explain_statistics
from vlatool.verify._other_episodes import Judge, Outcome
from vlatool.verify._reading import is_dense, names_of
from vlatool.verify._texts import unknown_texts
from vlatool.verify.log import MAX_WIDTH, LogOptions, explain_inputs, verify_log

Arrays = dict[str, Any]
STEPS = 60
TASKS = ("reach left", "reach right", "push it")
MEAN, STD = np.array([0.0, 0.3, 1.0]), np.array([0.2, 0.1, 0.5])


def episode(seed: int, start: float = 0.0) -> Arrays:
    """An arm whose x and y follow commands one step later, and whose third joint turns with both."""
    random = np.random.default_rng(seed)
    commands = np.repeat(random.normal(0, 0.02, (STEPS // 4, 2)), 4, axis=0)
    moved = np.concatenate([np.zeros((1, 2)), np.cumsum(commands, axis=0)[:-1]])
    x, y = start + moved[:, 0], 0.3 + moved[:, 1]
    proprio = np.stack([x, y, 1 + 2 * x - 3 * (y - 0.3)], axis=1) + random.normal(0, 2e-4, (STEPS, 3))
    row, column = (np.arange(8)[:, None] / 4 - 1), (np.arange(8)[None] / 4 - 1)
    near = np.exp(-8 * ((row - y[:, None, None] + 0.3) ** 2 + (column - x[:, None, None]) ** 2))
    scene = np.stack([60 + 40 * row + 0 * column, 50 + 0 * row - 30 * column, 120 - 20 * row + 20 * column], axis=-1)
    image = scene + near[..., None] * [150, 60, 10] + random.normal(0, 1, (STEPS, 8, 8, 3))
    image[:, 0, 0] = 255  # a lamp
    text = np.array([TASKS[seed % 3]] * STEPS)
    return {"image": np.clip(image, 0, 255).astype(np.uint8), "proprio": proprio.astype(np.float32),
            "instruction": text, "action": commands[:, None].astype(np.float32)}  # fmt: skip


def joined(episodes: list[Arrays]) -> Arrays:
    arrays = {name: np.concatenate([each[name] for each in episodes]) for name in episodes[0]}
    return {**arrays, "episode": np.repeat(np.arange(len(episodes)), [len(each["action"]) for each in episodes])}


def recording(bundle: Bundle, arrays: Arrays) -> Recording:
    return build_recording(Path("log.npz"), arrays, bundle.manifest.spec, {})


@pytest.fixture(scope="module")
def reference() -> Arrays:
    return joined([episode(seed) for seed in range(12)])


@pytest.fixture(scope="module")
def judge(source_bundle: Bundle, reference: Arrays) -> Judge:
    right, spec = recording(source_bundle, reference), source_bundle.manifest.spec
    return Judge.of(spec, names_of(spec, right, right, MAX_WIDTH), right)


@pytest.fixture
def judged(judge: Judge, source_bundle: Bundle) -> Callable[[Arrays], Outcome]:
    """A function that judges a log."""
    return lambda arrays: judge.explain(recording(source_bundle, arrays), {"proprio": (MEAN, STD)})


def other(*, start: float = 0.0) -> Arrays:
    return joined([episode(100, start), episode(101, start)])


def late(values: np.ndarray, steps: int) -> np.ndarray:
    rows = np.arange(len(values))
    return values[np.maximum(rows - steps, rows - rows % STEPS)]


WRONG = {
    "order": ("proprio", lambda v: v[:, [1, 0, 2]], "permuted", "[0] holds [1], [1] holds [0]"),
    "cycle": ("proprio", lambda v: v[:, [2, 0, 1]], "permuted", "[0] holds [2], [1] holds [0], [2] holds [1]"),
    "sign": ("proprio", lambda v: v * [1, -1, 1], "negated", "[1]"),
    "all signs": ("proprio", lambda v: -v, "negated", "all elements"),
    "degrees": ("proprio", lambda v: v * [1, 1, 180 / np.pi], "scaled", "[2]: degrees instead of radians"),
    "mm": ("proprio", lambda v: 1000 * v, "scaled", "all elements: mm instead of m"),
    "m": ("proprio", lambda v: v / 1000, "scaled", "all elements: m instead of mm"),
    "late": ("proprio", lambda v: late(v, 2), "delayed", "2 control steps late"),
    "normalised": ("proprio", lambda v: (v - MEAN) / STD, "statistics", "all elements: it is normalised already"),
    "BGR": ("image", lambda v: v[..., ::-1], "bgr", "red and blue are exchanged"),
    "mirror": ("image", lambda v: v[:, :, ::-1], "flipped", "left and right"),
    "image late": ("image", lambda v: late(v, 1), "delayed", "1 control step late"),
    "0-1": ("image", lambda v: v // 255, "scaled", "0-1 instead of 0-255"),
    "command sign": ("action", lambda v: v * [1, -1], "negated", "dy"),
    "command order": ("action", lambda v: v[..., ::-1], "permuted", "dx holds dy, dy holds dx"),
    "command late": ("action", lambda v: late(v, 1), "delayed", "1 control step late"),
    "no text": ("instruction", lambda v: np.full_like(v, ""), "text", "it is empty in 120 of 120 rows"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wired_wrong_is_named_without_common_rows(judged, case):
    name, change, kind, words = WRONG[case]
    log = other()
    outcome = judged({**log, name: change(log[name]).astype(log[name].dtype)})
    ((signal, named, where),) = [(each.signal, each.kind, each.where) for each in outcome.explanations]
    assert (signal, named) == (name, kind)
    assert where.startswith(words)


RIGHT = {
    "ordinary": lambda log: log,
    "other start": lambda log: other(start=0.15),
    "darker": lambda log: {**log, "image": (0.7 * log["image"]).astype(np.uint8)},
    "noise of the camera": lambda log: {**log, "image": np.clip(
        log["image"] + np.random.default_rng(0).normal(0, 8, log["image"].shape), 0, 255).astype(np.uint8)},
    "noise of the sensors": lambda log: {**log, "proprio": (
        log["proprio"] + np.random.default_rng(0).normal(0, 0.01, log["proprio"].shape)).astype(np.float32)},
    "short": lambda log: {name: values[:40] for name, values in log.items()},
    "at rest": lambda log: {name: np.repeat(values[:1], 60, axis=0) for name, values in log.items()},
}  # fmt: skip


@pytest.mark.parametrize("case", RIGHT)
def test_right_logs_of_other_episodes_are_not_accused(judged, case):
    assert judged(RIGHT[case](other())).explanations == ()


def test_two_signals_that_are_wrong_are_both_named(judged):
    log = other()
    outcome = judged({**log, "proprio": log["proprio"][:, [1, 0, 2]], "image": log["image"][..., ::-1]})
    assert {(each.signal, each.kind) for each in outcome.explanations} == {("image", "bgr"), ("proprio", "permuted")}


def test_what_a_log_at_rest_cannot_show_is_said(judged):
    outcome = judged(RIGHT["at rest"](other()))
    said = next(each for each in outcome.unseen if each.startswith("'proprio'"))
    assert "a delay of 1, 2, 3 control steps" in said
    assert {each.kind for name, each in outcome.components if name == "proprio"} >= {"delayed"}


def test_another_place_is_suspicious_and_not_called_wrong(judged):
    outcome = judged(other(start=2.0))
    assert outcome.explanations == ()
    assert any("another place, or an offset" in each for each in outcome.suspicious)


def test_black_images_are_suspicious(judged):
    log = other()
    outcome = judged({**log, "image": np.zeros_like(log["image"])})
    assert [each.kind for each in outcome.explanations if each.signal == "image"] == []
    assert any("every pixel is 0" in each for each in outcome.suspicious)


def test_a_log_numbered_like_the_reference_is_not_taken_for_it(source_bundle, judge, reference):
    right = recording(source_bundle, reference)
    _, paired = explain_inputs(source_bundle, recording(source_bundle, other()), [right], own=False, judge=judge)
    assert not paired


def test_the_report_names_the_verdict_and_its_evidence(source_bundle, tmp_path, reference):
    log = other()
    np.savez(tmp_path / "reference.npz", **reference)
    for name, arrays in {"wrong": {**log, "proprio": -log["proprio"]}, "odd": other(start=2.0)}.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
    wrong, odd = (verify_log(source_bundle, LogOptions(tmp_path / f"{name}.npz", tmp_path / "reference.npz"), Context())
                  for name in ("wrong", "odd"))  # fmt: skip
    assert (wrong.verdict, odd.verdict) == ("fail", "inconclusive")
    assert "in right episodes below" in wrong.summary[1]
    assert "certain" in wrong.summary[1]
    assert odd.summary[1].startswith("Suspicious: ")


@pytest.mark.parametrize(("kind", "right"), [("min_max", (-1.0, 2.0)), ("quantiles", (-0.97, 1.97)),
                                             ("quantile10", (-0.7, 1.7)), ("mean_std", (-0.37, 1.37))])  # fmt: skip
def test_statistics_of_every_kind_are_compared_with_the_recordings(kind, right):
    values = np.random.default_rng(0).uniform(-1, 2, (400, 1))
    low, high = right
    for factor, is_wrong in ((1.0, False), (1000.0, True), (0.001, True)):
        normaliser = Normaliser(*np.float32([[factor * (low + high) / 2], [factor * (high - low) / 2]]))
        found = explain_statistics("state", ["x"], values, normaliser, kind, whole=True)
        assert (found is not None) == is_wrong


@pytest.mark.parametrize(("apart", "dense"), [(1, True), (3, False)])
def test_rows_that_are_steps_apart_are_seen_by_their_chunks(source_bundle, apart, dense):
    actions = np.cumsum(np.random.default_rng(0).normal(size=(200, 2)), axis=0)
    rows = np.arange(0, 180, apart)
    log = {name: np.repeat(values[:1], len(rows), axis=0) for name, values in episode(0).items()}
    chunks = actions[rows[:, None] + np.arange(4)].astype(np.float32)
    assert is_dense(recording(source_bundle, {**log, "action": chunks}), source_bundle.manifest.spec) == dense


def test_texts_are_told_by_case_by_word_and_by_rarity():
    known, episodes = ["press the button"] * 60 + ["open the door"] * 60, range(120)
    said = {text: list(unknown_texts("t", [text], known, ([0], episodes)))
            for text in ("press the button", "Press the button.", "press the lever", "open the button")}  # fmt: skip
    assert said["press the button"] == []
    assert "it was written 'press the button'" in said["Press the button."][0]
    assert "nor was the word 'lever'" in said["press the lever"][0]
    assert "the nearest that was is" in said["open the button"][0]
    assert list(unknown_texts("t", ["go to a key"], ["go to a ball", "to the key"], ([0], [0, 1]))) == []
