"""What two bundles must have in common; the cheats of ``tests/gate/test_gate_cheats.py`` are refused by the same."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.image import Image, ImageStep
from vlatool.bundle.program import ProgramStep
from vlatool.errors import BundleError, DataError, GraphError
from vlatool.gate.claims.accuracy import Accuracy
from vlatool.gate.config import Gate
from vlatool.gate.same import check

GATE = Gate(accuracy=Accuracy(episodes=1))


def changed(bundle: Bundle, **fields) -> Bundle:
    return replace(bundle, manifest=replace(bundle.manifest, **fields))


def test_statistics_vocabulary_and_cuts_of_the_program_may_differ(float_bundle: Bundle) -> None:
    (step,) = float_bundle.manifest.program
    first = ProgramStep("main", step.feeds, {**step.gives})
    inputs = tuple(
        replace(each, statistics="other.json#state") if each.statistics else each
        for each in float_bundle.manifest.spec.inputs
    )
    spec = replace(float_bundle.manifest.spec, inputs=inputs)
    check(changed(float_bundle, program=(first, step), spec=spec), float_bundle, GATE)


def test_what_becomes_of_a_frame_may_differ(float_bundle: Bundle) -> None:
    first, *others = float_bundle.manifest.spec.inputs
    mine, theirs = (
        changed(float_bundle, spec=replace(float_bundle.manifest.spec, inputs=(replace(first, image=image), *others)))
        for image in (
            Image(layout="hwc", steps=(ImageStep("resize", (8, 8)),)),
            Image(layout="hwc", like="opencv", steps=(ImageStep("crop", (8, 8)),)),
        )
    )
    check(mine, theirs, GATE)


def test_all_of_a_chunk_may_be_said_in_two_ways(float_bundle: Bundle) -> None:
    all_of_it, as_many = (
        changed(float_bundle, spec=replace(float_bundle.manifest.spec, execute=execute)) for execute in (0, 4)
    )
    check(all_of_it, as_many, GATE)
    check(as_many, all_of_it, GATE)


def test_steps_that_a_stage_left_out_need_a_claim_of_accuracy(float_bundle: Bundle) -> None:
    with pytest.raises(DataError, match="runs fewer steps than the baseline, and no claim is made of its accuracy"):
        check(repeated(float_bundle, FEWER, "prune.steps"), repeated(float_bundle, FOUR), Gate(accuracy=None))


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (
            {"keep": {"count": {"shape": [1]}}},
            r"the program's keep \{'count': .*\} in the candidate, \{\} in the",
        ),
        ({"noise": {"x": {"shape": [1, 2]}}}, "the program's noise"),
        ({"repeat": 3, "schedule": {"t": [1.0, 0.5, 0.0]}}, r"the program's schedule .*; the program's repeat 3 in"),
    ],
)
def test_another_program_is_another_policy(float_bundle: Bundle, fields, says: str) -> None:
    (step,) = float_bundle.manifest.program
    with pytest.raises(BundleError, match=says):
        check(changed(float_bundle, program=(replace(step, **fields),)), float_bundle, GATE)


def repeated(bundle: Bundle, schedule: dict[str, list[float]], *stages: str) -> Bundle:
    """A bundle whose program repeats its graph as often as its schedule says, made by stages."""
    (step,) = bundle.manifest.program
    step = replace(step, repeat=len(next(iter(schedule.values()))), schedule=schedule)
    build = (*bundle.manifest.build, *({"stage": stage} for stage in stages))
    return changed(bundle, program=(step,), build=build)


FOUR = {"t": [1.0, 0.75, 0.5, 0.25], "dt": [-0.25] * 4}
FEWER = {"t": [1.0, 0.5], "dt": [-0.5] * 2}


def test_steps_may_become_fewer_where_a_stage_made_them_fewer(float_bundle: Bundle) -> None:
    whole = repeated(float_bundle, FOUR)
    check(repeated(float_bundle, FEWER, "prune.steps"), whole, GATE)
    check(repeated(float_bundle, FOUR, "prune.steps"), whole, GATE)
    with pytest.raises(BundleError, match=r"the program's schedule .*; the program's repeat 2 in the candidate, 4 in"):
        check(repeated(float_bundle, FEWER, "prune.depth"), whole, GATE)


@pytest.mark.parametrize(
    ("schedule", "says"),
    [
        ({"t": [1.0] * 8, "dt": [-0.125] * 8}, "the program's repeat 8 in the candidate, 4 in the baseline"),
        ({"t": [1.0, 0.7, 0.4, 0.1], "dt": [-0.3] * 4}, "the program's schedule"),
        ({"t": [1.0]}, "the program's schedule .*; the program's repeat 1 in"),
        ({"t": [1.0], "dt": [-1.0], "more": [0.0]}, "the program's schedule .*; the program's repeat 1 in"),
    ],
)
def test_fewer_steps_excuse_no_other_program(float_bundle: Bundle, schedule: dict[str, list[float]], says: str) -> None:
    with pytest.raises(BundleError, match=says):
        check(repeated(float_bundle, schedule, "prune.steps"), repeated(float_bundle, FOUR), GATE)


@pytest.mark.parametrize("word", ["keep", "noise"])
def test_fewer_steps_keep_and_draw_the_same(float_bundle: Bundle, word: str) -> None:
    fewer = repeated(float_bundle, FEWER, "prune.steps")
    step = replace(fewer.manifest.program[0], **{word: {"x": {"shape": [1]}}})
    with pytest.raises(BundleError, match=f"the program's {word}"):
        check(changed(fewer, program=(step,)), repeated(float_bundle, FOUR), GATE)


def test_an_engine_that_is_none_is_told(float_bundle: Bundle) -> None:
    with pytest.raises(BundleError, match="made for the engine 'ort_cpus'; did you mean 'ort_cpu'"):
        check(changed(float_bundle, engine="ort_cpus"), float_bundle, GATE)


def test_a_golden_action_is_not_left_out(float_bundle: Bundle) -> None:
    bare = changed(float_bundle, golden="")
    with pytest.raises(BundleError, match="has no golden action, which the baseline has"):
        check(bare, float_bundle, GATE)
    check(float_bundle, bare, GATE)


@pytest.mark.parametrize("content", [b"\xff" * 100, b"PK\x03\x04" + bytes(200)])
def test_a_graph_that_is_no_onnx_is_named(float_bundle: Bundle, tmp_path: Path, content: bytes) -> None:
    shutil.copytree(float_bundle.path, tmp_path / "made")
    (tmp_path / "made/graphs/main.onnx").write_bytes(content)
    candidate = seal(tmp_path / "made", float_bundle.manifest)
    with pytest.raises(GraphError, match=r"main\.onnx cannot be read as an ONNX file"):
        check(candidate, float_bundle, Gate())
