"""Programs of two systems: which steps are slow, and what their manifests say to older versions."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from vlatool.bundle.manifest import SCHEMA, FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep, SlowPart, check_program, latent_names, program_from, slow_part
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError, SpecError

SPEC = PolicySpec((TensorSpec("scene", (1, 2)), TensorSpec("state", (1, 2))), (TensorSpec("action", (1, 2)),), 100.0)
SLOW = {"max_age_ms": 500.0, "hz": 5.0}
SEE = ProgramStep("see", {"scene": "scene"}, {"seen": "seen"}, slow=SLOW)
THINK = ProgramStep("think", {"seen": "seen", "memory": "memory"}, {"thought": "thought", "next": "memory"},
                    keep={"memory": {"shape": [1, 2]}}, slow=SLOW)  # fmt: skip
ACT = ProgramStep("act", {"thought": "thought", "state": "state", "x": "x"}, {"action": "action"},
                  noise={"x": {"shape": [1, 2]}})  # fmt: skip
PROGRAM = (SEE, THINK, ACT)


def manifest(program: tuple[ProgramStep, ...]) -> Manifest:
    names = {step.graph for step in program}
    files = {f"{name}.onnx": FileRecord("0" * 64, 1) for name in names}
    return Manifest("two", "1", SPEC, {name: Graph(f"{name}.onnx") for name in names}, program, files)


def test_a_program_says_how_its_slow_part_runs():
    check_program(PROGRAM, ["see", "think", "act"], SPEC)
    assert slow_part(PROGRAM) == SlowPart(500.0, 5.0)
    assert slow_part([replace(SEE, slow={"max_age_ms": 300})]) == SlowPart(300.0, None)
    assert slow_part([ACT]) is None
    assert latent_names(PROGRAM, SPEC) == {"thought"}
    spec = replace(SPEC, outputs=(*SPEC.outputs, TensorSpec("seen", (1, 2))))
    assert latent_names(PROGRAM, spec) == {"thought", "seen"}, "an output of the slow part is passed on"


def test_only_a_manifest_with_a_slow_part_needs_a_newer_reader():
    plain = manifest(tuple(replace(step, slow={}) for step in PROGRAM))
    assert plain.schema == 1
    assert "slow" not in json.dumps(plain.to_dict())
    two = manifest(PROGRAM)
    assert two.schema == SCHEMA == 3
    data = json.loads(json.dumps(two.to_dict()))
    assert Manifest.from_dict(data) == two
    with pytest.raises(BundleError, match="has the schema 2, but a program with 'slow', which begins with 3"):
        Manifest.from_dict({**data, "schema": 2})
    with pytest.raises(BundleError, match=r"schema 4; this vlatool reads up to 3\."):
        Manifest.from_dict({**data, "schema": 4})


@pytest.mark.parametrize(
    ("slow", "words"),
    [
        ({"hz": 5}, "has no 'max_age_ms'"),
        ({"max_age_ms": 0}, "allowed: a number of milliseconds above 0"),
        ({"max_age_ms": "long"}, "max_age_ms"),
        ({"max_age_ms": 5, "hz": -1}, "allowed: a number of Hz above 0"),
        ({"max_age_ms": 5, "rate": 1}, "rate"),
        ({"max_age_ms": float("inf")}, "max_age_ms"),
        (5, "'slow' of 'see'"),
    ],
)
def test_a_slow_part_that_makes_no_sense_is_refused(slow: Any, words: str):
    step = {"graph": "see", "feeds": {"scene": "scene"}, "gives": {"seen": "seen"}, "slow": slow}
    with pytest.raises(SpecError, match=words):
        program_from([step])


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ((SEE, THINK), "not followed by a fast part"),
        ((SEE, replace(THINK, slow={}), replace(ACT, slow=SLOW)), "not followed by a fast part alone"),
        ((SEE, replace(THINK, slow={"max_age_ms": 1}), ACT), "write the same in each step"),
        ((SEE, THINK, ACT, replace(SEE, slow={})), "Both parts run the graph 'see'"),
        ((SEE, THINK, replace(ACT, noise={}, keep={"thought": {"shape": [1, 2]}}, feeds={"thought": "thought"})),
         "'thought' is kept by one part and given by the other"),
        ((SEE, replace(THINK, noise={"x": {"shape": [1, 2]}}), ACT), "Both parts draw the noise 'x'"),
        ((SEE, replace(THINK, gives={"action": "action", "n": "memory"}), replace(ACT, feeds={}, gives={"y": "y"})),
         "does not give the action"),
        ((SEE, THINK, replace(ACT, feeds={"state": "state"})), "uses nothing of the slow part"),
    ],
)  # fmt: skip
def test_parts_that_cannot_run_beside_each_other_are_refused(program: tuple[ProgramStep, ...], words: str):
    with pytest.raises(SpecError, match=words):
        check_program(program, ["see", "think", "act"], SPEC)
