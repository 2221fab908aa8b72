"""Every field of a candidate's manifest: compared with the baseline's, or of no account for a verdict."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from vlatool.bundle.bundle import Bundle, replace_manifest
from vlatool.bundle.conversion import Conversion
from vlatool.bundle.image import Image
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import VlatoolError
from vlatool.gate import run as run_gate_module
from vlatool.gate.claims.accuracy import Accuracy
from vlatool.gate.config import Gate
from vlatool.gate.run import run_gate
from vlatool.gate.same import check
from vlatool.measurement.agreement import run_agreement
from vlatool.stage.base import Context

sys.path.insert(0, str(Path(__file__).parents[1] / "validation/soak/attacks"))

from gate_bundles import of
from gate_graphs import wrong_when

CLASSES = (Manifest, Graph, FileRecord, PolicySpec, TensorSpec, ProgramStep)
TRUST = Path(__file__).parents[2] / "docs/concepts/trust.md"
GATE = Gate(latency=None, memory=None, answers=None, accuracy=Accuracy(max_drop=0.5))
PLAYED = Gate(accuracy=Accuracy(episodes=4))

Change = Callable[[Manifest], Manifest]


def manifest(**values: Any) -> Change:
    return lambda before: replace(before, **values)


def spec(**values: Any) -> Change:
    return lambda before: replace(before, spec=replace(before.spec, **values))


def tensor(tensors: str, place: int, **values: Any) -> Change:
    """The same manifest with another input or output."""

    def change(before: Manifest) -> Manifest:
        known = list(getattr(before.spec, tensors))
        known[place] = replace(known[place], **values)
        return replace(before, spec=replace(before.spec, **{tensors: tuple(known)}))

    return change


def renamed(before: Manifest) -> Manifest:
    """The first input under another name, in the program as well."""
    (first, *others), (only,) = before.spec.inputs, before.program
    feeds = {name: "picture" if value == first.name else value for name, value in only.feeds.items()}
    inputs = (replace(first, name="picture"), *others)
    return replace(before, spec=replace(before.spec, inputs=inputs), program=(replace(only, feeds=feeds),))


def one_more_output(before: Manifest) -> Manifest:
    """The action once more, as an output beside it."""
    (only,), action = before.program, before.spec.action
    again = replace(only, gives=dict.fromkeys(only.gives, "value"))
    spec = replace(before.spec, outputs=(action, replace(action, name="value")))
    return replace(before, spec=spec, program=(only, again))


def step(**values: Any) -> Change:
    return lambda before: replace(before, program=(replace(before.program[0], **values), *before.program[1:]))


def graph(**values: Any) -> Change:
    return lambda before: replace(before, graphs={"main": replace(before.graphs["main"], **values)})


def text_input(**values: Any) -> Change:
    def change(before: Manifest) -> Manifest:
        place = next(place for place, each in enumerate(before.spec.inputs) if each.kind == "text")
        return tensor("inputs", place, **values)(before)

    return change


def float_input(**values: Any) -> Change:
    def change(before: Manifest) -> Manifest:
        place = next(place for place, each in enumerate(before.spec.inputs) if each.dtype == "float32")
        return tensor("inputs", place, **values)(before)

    return change


COMPARED: dict[str, tuple[Change, str]] = {
    "TensorSpec.name": (renamed, "input image: it is in the baseline alone"),
    "TensorSpec.shape": (tensor("outputs", 0, shape=(1, 2, 2)), "shape"),
    "TensorSpec.dtype": (tensor("inputs", 0, dtype="float32"), "dtype 'float32' in the candidate"),
    "TensorSpec.kind": (tensor("outputs", 0, kind="discrete", labels=("dx", "dy")), "kind 'discrete'"),
    "TensorSpec.unit": (tensor("outputs", 0, unit="mm"), "unit 'mm' in the candidate"),
    "TensorSpec.labels": (tensor("outputs", 0, labels=("dy", "dx")), "labels"),
    "TensorSpec.mode": (tensor("outputs", 0, mode="absolute"), "mode 'absolute'"),
    "TensorSpec.max_tokens": (text_input(max_tokens=1), "max_tokens 1 in the candidate"),
    "TensorSpec.finite": (float_input(finite=False), "finite False in the candidate, True in the baseline"),
    "TensorSpec.image": (
        tensor("inputs", 0, image=Image(frame="bgr", layout="hwc", camera=(8, 8))),
        "frame 'bgr' in the candidate, '' in the baseline",
    ),
    "TensorSpec.history": (tensor("inputs", 0, history=8), "history 8 in the candidate, 0 in the baseline"),
    "TensorSpec.parts": (tensor("outputs", 0, parts={"arm": (0, 2)}), "parts {'arm': \\(0, 2\\)} in the candidate"),
    "TensorSpec.convert": (
        tensor("outputs", 0, convert=(Conversion("scale", (0,), factor=(-1.0,)),)),
        r"convert \['scale, parts \[0\], factor \[-1.0\]'\] in the candidate, \[\] in the baseline",
    ),
    "PolicySpec.inputs": (
        lambda before: spec(inputs=(*before.spec.inputs, TensorSpec("gripper", (1, 1))))(before),
        "input gripper: it is in the candidate alone",
    ),
    "PolicySpec.outputs": (one_more_output, "output value: it is in the candidate alone"),
    "PolicySpec.control_hz": (spec(control_hz=1.0), r"control_hz 1\.0 in the candidate"),
    "PolicySpec.chunk": (spec(chunk=2, execute=0), "chunk 2 in the candidate"),
    "PolicySpec.execute": (spec(execute=1), "executed 1 in the candidate"),
    "ProgramStep.repeat": (step(repeat=3), "the program's repeat 3"),
    "ProgramStep.schedule": (step(schedule={"t": [1.0]}), "the program's schedule"),
    "ProgramStep.noise": (step(noise={"x": {"shape": [1, 2]}}), "the program's noise"),
    "ProgramStep.keep": (step(keep={"x": {"shape": [1, 2]}}), "the program's keep"),
    "Manifest.environment": (manifest(environment={"make": "environment.py:make", "tasks": ["reach"]}),
                             r"environment: tasks \['reach'\] in the candidate, \['reach', 'push'\] in the baseline"),
    "Manifest.golden": (manifest(golden=""), "has no golden action"),
    "Manifest.golden_tolerance": (manifest(golden_tolerance=1e9), "load accepts any action"),
    "Manifest.golden_chunk_tolerance": (manifest(golden_chunk_tolerance=2.0), "load accepts any action"),
}  # fmt: skip
"""Field -> another manifest, and what the gate says of it."""
OWN: dict[str, Change] = {
    "Manifest.name": manifest(name="easier"),
    "Manifest.version": manifest(version="99.0"),
    "Manifest.parent": manifest(parent="sha256:" + 64 * "0"),
    "Manifest.made_by": manifest(made_by={"stage": "quantize.nothing", "candidate": "best"}),
    "Manifest.build": manifest(build=({"stage": "prune.steps"},)),
    "Manifest.source": manifest(source={"factory": "other.py:make"}),
    "Manifest.parts": manifest(parts={"all": ["*"]}),
    "Manifest.accuracy": manifest(accuracy={"success": {"value": 1.0}, "success_drop": {"value": -1.0}}),
    "Manifest.description": manifest(description="it passes"),
    "Manifest.license": manifest(license="MIT"),
    "Graph.precision": graph(precision={"int8": 1.0}),
    "Graph.opset": graph(opset=1),
    "Manifest.environment, none": manifest(environment={}),
}
"""Field -> another manifest, of which the verdict is that of the same bundle."""


@pytest.mark.parametrize("name", COMPARED)
def test_a_field_that_counts_is_compared(float_bundle: Bundle, name: str) -> None:
    change, says = COMPARED[name]
    other = replace(float_bundle, manifest=change(float_bundle.manifest))
    gate = PLAYED if name == "Manifest.environment" else GATE
    with pytest.raises(VlatoolError, match=says):
        check(other, float_bundle, gate)


@pytest.fixture(scope="module")
def here():
    """The gate without processes of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_gate_module, "measure_agreement", lambda job, timeout: run_agreement(job))
        yield


@pytest.fixture(scope="module")
def claims_of_the_same(float_bundle: Bundle, here) -> list[dict[str, Any]]:
    return claims(float_bundle, float_bundle)


def claims(candidate: Bundle, baseline: Bundle, gate: Gate = GATE) -> list[dict[str, Any]]:
    return run_gate(candidate, baseline, gate, Context(), seed=1).rows[1].details["claims"]


@pytest.mark.parametrize("name", OWN)
def test_a_field_of_the_candidates_own_changes_no_verdict(
    float_bundle: Bundle, claims_of_the_same, copied, name: str
) -> None:
    other = copied(float_bundle)
    assert claims(replace_manifest(other, OWN[name](other.manifest)), float_bundle) == claims_of_the_same


def test_no_field_of_its_own_saves_a_candidate_that_is_wrong(float_bundle: Bundle, here, tmp_path: Path) -> None:
    wrong = of(wrong_when(None))(float_bundle, tmp_path / "wrong")
    gate = GATE.model_copy(update={"answers": Gate().answers})
    found = claims(wrong, float_bundle, gate)
    assert {each["claim"]: each["verdict"] for each in found}["answers"] == "fail"
    embellished = wrong.manifest
    for change in OWN.values():
        embellished = change(embellished)
    assert claims(replace_manifest(wrong, embellished), float_bundle, gate) == found


def test_the_documentation_says_of_each_field_who_decides() -> None:
    """A field that is added must be thought about: who decides it, and which test shows that?"""
    rows = [line for line in TRUST.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    told = {name for line in rows for name in re.findall(r"`(\w+\.\w+)`", line.split("|")[1])}
    assert told >= {f"{kind.__name__}.{item.name}" for kind in CLASSES for item in fields(kind)}
