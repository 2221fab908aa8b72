"""Logs of robots that are wired right, and of robots of which one thing is wired wrong."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _tiny import observations

from vlatool.bundle.bundle import Bundle, seal
from vlatool.cli import main
from vlatool.data import build_recording
from vlatool.errors import DataError
from vlatool.measures import tables
from vlatool.report import Report
from vlatool.runtime import load
from vlatool.stage.base import Context
from vlatool.verify._actions import _of_indices
from vlatool.verify._pairing import Pairs, pair_rows
from vlatool.verify.log import EXPLANATIONS, LogOptions, explain_inputs, verify_log

Arrays = dict[str, Any]
ROWS = 80
MEAN, STD = (np.array([0.1, -0.2, 0.5]), np.array([0.5, 0.25, 2.0]))


def recorded(seed: int = 5, rows: int = ROWS) -> Arrays:
    """Inputs of one episode of the tiny policy."""
    arrays = observations(rows, seed)
    return {name: arrays[name] for name in ("image", "proprio", "instruction")} | {"episode": np.zeros(rows, np.int64)}


def with_noise(arrays: Arrays, seed: int = 1) -> Arrays:
    """The same, seen by sensors with noise."""
    random = np.random.default_rng(seed)
    proprio = arrays["proprio"] + random.normal(0, 0.01 * STD, arrays["proprio"].shape)
    image = np.clip(arrays["image"] + random.normal(0, 3, arrays["image"].shape), 0, 255)
    return {**arrays, "proprio": proprio.astype(np.float32), "image": image.round().astype(np.uint8)}


@pytest.fixture
def verified(source_bundle: Bundle, tmp_path: Path) -> Callable[..., Report]:
    """A function that compares a log with a reference."""

    def run(log: Arrays, reference: Arrays | None = None, bundle: Bundle = source_bundle) -> Report:
        np.savez(tmp_path / "log.npz", **log)
        np.savez(tmp_path / "reference.npz", **(reference or recorded()))
        return verify_log(bundle, LogOptions(tmp_path / "log.npz", tmp_path / "reference.npz"), Context())

    return run


def found(report: Report) -> list[tuple[str, str, str]]:
    """Signal, kind and words of each explanation of a report."""
    (row,) = report.rows
    return [(each["signal"], each["explanation"], each["where"]) for each in row.details.get(EXPLANATIONS, [])]


def changed(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Arrays:
    """A log with noise in which one input is changed."""
    arrays = with_noise(recorded())
    values = change(arrays[name].astype(np.float64) if name == "proprio" else arrays[name])
    return {**arrays, name: values.astype(arrays[name].dtype)}


def late(values: np.ndarray, steps: int) -> np.ndarray:
    return np.concatenate([np.repeat(values[:1], steps, axis=0), values[:-steps]])


WRONG = {
    "order": ("proprio", lambda v: v[:, [1, 0, 2]], "permuted", "[0] holds [1], [1] holds [0]"),
    "cycle": ("proprio", lambda v: v[:, [2, 0, 1]], "permuted", "[0] holds [2], [1] holds [0], [2] holds [1]"),
    "sign": ("proprio", lambda v: v * [1, -1, 1], "negated", "[1]"),
    "all signs": ("proprio", lambda v: -v, "negated", "all elements"),
    "degrees": ("proprio", lambda v: v * [1, 1, 180 / math.pi], "scaled", "[2]: degrees instead of radians"),
    "mm": ("proprio", lambda v: 1000 * v, "scaled", "all elements: mm instead of m"),
    "another scale": ("proprio", lambda v: v * [1, 1.7, 1], "scaled", "[1]: 1.70"),
    "offset": ("proprio", lambda v: v + np.array([0, 0, 1.5]), "offset", "[2]: by 1."),
    "late": ("proprio", lambda v: late(v, 2), "delayed", "2 control steps late"),
    "normalised": ("proprio", lambda v: (v - MEAN) / STD, "statistics", "all elements: it is normalised already"),
    "BGR": ("image", lambda v: v[..., ::-1], "bgr", "red and blue are exchanged"),
    "mirror": ("image", lambda v: v[:, :, ::-1], "flipped", "left and right"),
    "upside down": ("image", lambda v: v[:, ::-1], "flipped", "upside down"),
    "turned": ("image", lambda v: v[:, ::-1, ::-1], "flipped", "turned by 180 degrees"),
    "image late": ("image", lambda v: late(v, 1), "delayed", "1 control step"),
    "0-1": ("image", lambda v: v // 255, "scaled", "0-1 instead of 0-255"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wired_wrong_is_named_and_nothing_else_is(verified, case):
    name, change, kind, words = WRONG[case]
    report = verified(changed(name, change))
    ((signal, named, where),) = found(report)
    assert (report.verdict, signal, named) == ("fail", name, kind)
    assert where.startswith(words)


def test_a_log_with_noise_of_the_same_episode_is_right(verified, source_bundle):
    report = verified(with_noise(recorded()))
    assert (report.verdict, found(report), report.warnings) == ("pass", [], ())
    assert "compared row by row, on 80 rows" in report.summary[0]
    assert report.rows[0].details[tables.IDENTITY]


@pytest.mark.parametrize("rows", [ROWS, 50, 5])
def test_other_episodes_are_right_and_what_they_cannot_show_is_said(verified, rows):
    report = verified(recorded(seed=9, rows=rows))
    assert (report.verdict, found(report)) == ("pass", [])
    assert "this log could not show" in report.warnings[0]


def test_two_faults_of_one_signal_are_both_named(verified):
    kinds = [each[1] for each in found(verified(changed("proprio", lambda v: late(v[:, [1, 0, 2]] * -1, 1))))]
    assert kinds == ["delayed", "permuted", "negated"]


def test_a_unit_is_seen_in_other_episodes_too(verified):
    log = recorded(seed=9)
    report = verified({**log, "proprio": 1000 * log["proprio"]})
    assert [each[:2] for each in found(report)] == [("proprio", "scaled")]
    assert "mm instead of m" in found(report)[0][2]


def test_a_part_of_the_log_is_paired_by_time_stamps(source_bundle):
    spec = source_bundle.manifest.spec
    inputs = {name: values for name, values in recorded().items() if name != "episode"}
    times = np.arange(ROWS) / spec.control_hz
    whole = build_recording(Path("r"), inputs, spec, {}, times)
    part = build_recording(Path("l"), {name: values[30:60] for name, values in inputs.items()}, spec, {},
                           times[30:60] + 0.02)  # fmt: skip
    assert pair_rows(part, whole, spec.control_hz)[2].reference.tolist() == list(range(28, 58))
    outcome, paired = explain_inputs(source_bundle, part, [whole], own=False)
    assert (outcome.explanations, paired) == ((), True)


def test_statistics_of_other_data_are_named(verified, source_bundle, copied):
    bundle = copied(source_bundle)
    path = bundle.path / "assets/statistics.json"
    table = json.loads(path.read_text())
    table["proprio"] = {key: [1000 * value for value in values] for key, values in table["proprio"].items()}
    path.write_text(json.dumps(table))
    report = verified(with_noise(recorded()), bundle=seal(bundle.path, bundle.manifest))
    where = "those of the spec are not of the recorded data in [0], [1], [2]"
    assert found(report) == [("proprio", "statistics", where)]


def test_frames_and_histories_of_another_size_are_compared_or_left_out(source_bundle, copied):
    bundle = copied(source_bundle)
    spec = bundle.manifest.spec
    image, proprio, text = spec.inputs
    inputs = (replace(image, shape=(1, "h", "w", 3)), replace(proprio, shape=(1, "n", 3)), text)
    bundle = seal(bundle.path, replace(bundle.manifest, spec=replace(spec, inputs=inputs)))
    arrays = recorded()
    right = {**arrays, "proprio": arrays["proprio"][:, None], "image": arrays["image"].repeat(5, 1).repeat(5, 2)}
    larger = {**right, "image": right["image"].repeat(2, 1).repeat(2, 2)[..., ::-1]}
    longer = {**larger, "proprio": right["proprio"].repeat(2, 1), "image": arrays["image"]}
    log, other, reference = (
        build_recording(Path("r"), each, bundle.manifest.spec, {}) for each in (larger, longer, right)
    )
    outcome, paired = explain_inputs(bundle, log, [reference], own=False)
    assert ([each.kind for each in outcome.explanations], paired) == (["bgr"], True)
    outcome, paired = explain_inputs(bundle, other, [reference], own=False)
    assert (outcome.explanations, paired) == ((), False)


def test_signals_that_are_exchanged_are_named(source_bundle, copied):
    bundle = copied(source_bundle)
    spec = bundle.manifest.spec
    other = replace(spec.inputs[1], name="other")
    bundle = seal(bundle.path, replace(bundle.manifest, spec=replace(spec, inputs=(*spec.inputs, other))))
    arrays = {**recorded(), "other": recorded(seed=7)["proprio"]}
    crossed = {**arrays, "proprio": arrays["other"], "other": arrays["proprio"]}
    log, reference = (build_recording(Path("r"), each, bundle.manifest.spec, {}) for each in (crossed, arrays))
    outcome, paired = explain_inputs(bundle, log, [reference], own=False)
    assert paired
    assert [(each.signal, each.kind, each.where) for each in outcome.explanations] == [
        ("proprio", "swapped", "it holds 'other'"), ("other", "swapped", "it holds 'proprio'"),
    ]  # fmt: skip


COMMANDS = {
    "right": (lambda action, state: action, None),
    "order": (lambda action, state: action[:, ::-1], ("permuted", "dx holds dy, dy holds dx")),
    "sign": (lambda action, state: action * [1, -1], ("negated", "dy")),
    "unit": (lambda action, state: 1000 * action, ("scaled", "all elements: mm instead of m")),
    "late": (lambda action, state: late(action, 1), ("delayed", "1 control step late")),
    "targets": (lambda action, state: action + state[:, :2], ("absolute", "a target, where the policy gives")),
    "noise": (lambda action, state: np.random.default_rng(3).normal(0, 0.1, action.shape), None),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_commands_are_compared_with_what_the_policy_gives(verified, float_bundle, case):
    change, expected = COMMANDS[case]
    log, policy = recorded(), load(float_bundle.path, threads=1)
    given = [
        policy.infer({"image": image, "proprio": state, "instruction": str(text)}).chunk[0]
        for image, state, text in zip(log["image"], log["proprio"], log["instruction"], strict=True)
    ]
    commands = change(np.asarray(given, np.float64), log["proprio"].astype(np.float64)).astype(np.float32)
    explanations = found(verified({**log, "action": commands}, bundle=float_bundle))
    if expected is None:
        assert explanations == []
    else:
        ((signal, kind, where),) = explanations
        assert (signal, kind) == ("action", expected[0])
        assert where.startswith(expected[1])


def test_discrete_commands_of_another_order_or_late_are_named(float_bundle):
    action = replace(float_bundle.manifest.spec.action, kind="discrete", shape=(1, 3), labels=("left", "right", "on"),
                     unit="", normalisation="none", statistics="", mode="")  # fmt: skip
    spec = replace(float_bundle.manifest.spec, outputs=(action,), chunk=1, execute=1)
    given = np.random.default_rng(0).integers(0, 3, 60)
    rows = np.arange(60)
    pairings = {0: Pairs(rows, rows), 1: Pairs(rows[1:], rows[:-1])}
    assert list(_of_indices(spec, given, given.astype(float), pairings)) == []
    (crossed,) = _of_indices(spec, np.array([1, 0, 2])[given], given.astype(float), pairings)
    assert (crossed.kind, crossed.where) == ("permuted", "left is sent for right, right is sent for left")
    (delayed,) = _of_indices(spec, np.roll(given, 1), given.astype(float), pairings)
    assert (delayed.kind, delayed.where) == ("delayed", "1 control steps")


def test_the_bundles_own_recording_is_the_reference(float_bundle, tmp_path):
    arrays = dict(np.load(float_bundle.path / "data/evaluation.npz"))
    np.savez(tmp_path / "log.npz", **{**arrays, "proprio": arrays["proprio"][:, [1, 0, 2]]})
    report = verify_log(float_bundle, LogOptions(tmp_path / "log.npz"), Context())
    assert found(report)[0] == ("proprio", "permuted", "[0] holds [1], [1] holds [0]")


def test_without_a_recording_there_is_nothing_to_compare_with(source_bundle, copied, tmp_path):
    bundle = copied(source_bundle)
    for path in (bundle.path / "data").iterdir():
        path.unlink()
    np.savez(tmp_path / "log.npz", **recorded())
    with pytest.raises(DataError, match="no recording to compare with"):
        verify_log(seal(bundle.path, bundle.manifest), LogOptions(tmp_path / "log.npz"), Context())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "takes one of --against and --log; got neither"),
        (["--log", "x.npz", "--against", "y.py:act"], "got both"),
        (["--log", "x.npz", "--data", "z.npz"], "--data and --map are for --against"),
        (["--against", "y.py:act", "--reference", "z.npz"], "--reference is for --log"),
    ],
)
def test_options_that_exclude_each_other_are_refused(float_bundle, capfd, options, words):
    with pytest.raises(SystemExit, match="2"):
        main(["verify", str(float_bundle.path), *options])
    assert words in capfd.readouterr().err


def test_the_command_exits_by_what_it_finds(float_bundle, tmp_path, capfd):
    arrays = dict(np.load(float_bundle.path / "data/evaluation.npz"))
    line = ["verify", str(float_bundle.path), "--log", str(tmp_path / "log.npz")]
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(SystemExit, match="0"):
        main(line)
    np.savez(tmp_path / "log.npz", **{**arrays, "image": arrays["image"][..., ::-1]})
    with pytest.raises(SystemExit, match="1"):
        main(line)
    assert "'image' is bgr: red and blue are exchanged" in capfd.readouterr().out
