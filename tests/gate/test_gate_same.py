"""What two bundles must have in common; the cheats of ``tests/gate/test_gate_cheats.py`` are refused by the same."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.errors import BundleError
from vlatool.gate.config import AccuracyClaim, Gate
from vlatool.gate.same import check

GATE = Gate(accuracy=AccuracyClaim(episodes=1))


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


def test_an_engine_that_is_none_is_told(float_bundle: Bundle) -> None:
    with pytest.raises(BundleError, match="made for the engine 'ort_cpus'; did you mean 'ort_cpu'"):
        check(changed(float_bundle, engine="ort_cpus"), float_bundle, GATE)


def test_a_golden_action_is_not_left_out(float_bundle: Bundle) -> None:
    bare = changed(float_bundle, golden="")
    with pytest.raises(BundleError, match="has no golden action, which the baseline has"):
        check(bare, float_bundle, GATE)
    check(float_bundle, bare, GATE)
