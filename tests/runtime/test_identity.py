"""What changes a robot's behaviour changes the identity of its policy, and nothing else does."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from vlatool.bundle.bundle import Bundle, replace_manifest, seal
from vlatool.bundle.conversion import Conversion
from vlatool.bundle.image import Image, ImageStep
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import SpecError
from vlatool.runtime import load
from vlatool.runtime.identity import policy_identity

Edit = Callable[[Bundle], Manifest]


def _with_spec(**fields: Any) -> Edit:
    return lambda bundle: replace(bundle.manifest, spec=replace(bundle.manifest.spec, **fields))


def _with_tensor(side: str, index: int, **fields: Any) -> Edit:
    def edit(bundle: Bundle) -> Manifest:
        tensors = list(getattr(bundle.manifest.spec, side))
        tensors[index] = replace(tensors[index], **fields)
        return replace(bundle.manifest, spec=replace(bundle.manifest.spec, **{side: tuple(tensors)}))

    return edit


def _with_step(**fields: Any) -> Edit:
    return lambda bundle: replace(bundle.manifest, program=(replace(bundle.manifest.program[0], **fields),))


def _with_statistics(change: Callable[[dict[str, Any]], object], indent: int | None = None) -> Edit:
    def edit(bundle: Bundle) -> Manifest:
        path = bundle.path / "assets/statistics.json"
        table = json.loads(path.read_text())
        change(table)
        path.write_text(json.dumps(table, indent=indent))
        return bundle.manifest

    return edit


def _with_word(bundle: Bundle) -> Manifest:
    path = bundle.path / "assets/vocabulary.json"
    path.write_text(path.read_text().replace('"red": 5, "blue": 6', '"red": 6, "blue": 5'))
    return bundle.manifest


def _with_weight(bundle: Bundle) -> Manifest:
    path = bundle.path / "graphs/main.onnx"
    model = onnx.load(path)
    weight = next(each for each in model.graph.initializer if each.name and each.data_type == 1 and each.raw_data)
    values = np.frombuffer(weight.raw_data, np.float32).copy()
    values[-1] = np.nextafter(values[-1], np.float32(9))
    weight.raw_data = values.tobytes()
    onnx.save(model, path)
    return bundle.manifest


def _reordered(bundle: Bundle) -> Manifest:
    first, second, *others = bundle.manifest.spec.inputs
    return _with_spec(inputs=(second, first, *others))(bundle)


def _renamed_input(bundle: Bundle) -> Manifest:
    spec, (step,) = bundle.manifest.spec, bundle.manifest.program
    image, proprio, text = spec.inputs
    named = replace(spec, inputs=(image, replace(proprio, name="state"), text))
    return replace(bundle.manifest, spec=named, program=(replace(step, feeds={**step.feeds, "proprio": "state"}),))


def _one_unit(side: str, index: int) -> Edit:
    return _with_tensor(side, index, unit=("m", "m", "deg") if side == "inputs" else ("m", "mm"))


DIFFERENT: dict[str, Edit] = {
    "an element of the mean": _with_statistics(lambda table: table["proprio"]["mean"].__setitem__(2, 0.5001)),
    "an element of the std": _with_statistics(lambda table: table["action"]["std"].__setitem__(0, 0.0501)),
    "statistics of another tensor": _with_tensor("outputs", 0, statistics="statistics.json#action2"),
    "swapped labels": _with_tensor("outputs", 0, labels=("dy", "dx")),
    "unit of an input": _one_unit("inputs", 1),
    "unit of the action": _one_unit("outputs", 0),
    "mode": _with_tensor("outputs", 0, mode="absolute"),
    "name of an input": _renamed_input,
    "rate": _with_spec(control_hz=10.5),
    "executed actions": _with_spec(execute=3),
    "epsilon": _with_tensor("inputs", 1, epsilon=1e-8),
    "parts": _with_tensor("outputs", 0, parts={"arm": (0, 2)}),
    "relative": _with_tensor("outputs", 0, mode="", convert=(Conversion("relative", (0,), "proprio"),)),
    "a sign": _with_tensor("inputs", 1, convert=(Conversion("scale", (0,), factor=(-1.0,)),)),
    "a bound": _with_tensor("outputs", 0, convert=(Conversion("clip", high=(1.0,)),)),
    "another bound": _with_tensor("outputs", 0, convert=(Conversion("clip", high=(2.0,)),)),
    "relative to another element": _with_tensor(
        "outputs", 0, mode="", convert=(Conversion("relative", (0,), "proprio", (1,)),)
    ),
    "NaN allowed": _with_tensor("inputs", 1, finite=False),
    "reordered inputs": _reordered,
    "tokens": _with_tensor("inputs", 2, max_tokens=3),
    "a word": _with_word,
    "a bit of a weight": _with_weight,
    "compute": lambda bundle: replace(
        bundle.manifest, graphs={"main": replace(bundle.manifest.graphs["main"], compute="bfloat16")}
    ),
    "repeats": _with_step(repeat=2),
    "schedule": _with_step(schedule={"t": [0.5]}),
    "noise": _with_step(noise={"x": {"shape": [1, 4]}}),
    "kept values": _with_step(keep={"x": {"shape": [1, 4]}}),
    "crossed feeds": _with_step(feeds={"image": "image", "proprio": "proprio", "instruction": "proprio"}),
}
SAME: dict[str, Edit] = {
    "name": lambda bundle: replace(bundle.manifest, name="another", version="9", description="x", license="MIT"),
    "origin": lambda bundle: replace(bundle.manifest, made_by={"stage": "x"}, build=(), parent="", source={}),
    "accuracy": lambda bundle: replace(bundle.manifest, accuracy={"success": {"value": 0.5, "samples": 2}}),
    "golden tolerance": lambda bundle: replace(bundle.manifest, golden_tolerance=0.01, findings=()),
    "80 and 80.0": _with_spec(control_hz=10.0),
    "the same executed actions": _with_spec(execute=2),
    "layout of the statistics": _with_statistics(lambda table: table.setdefault("unused", {}), indent=3),
    "one unit for all": _with_tensor("outputs", 0, unit="m"),
}


@pytest.fixture
def edited(float_bundle: Bundle, tmp_path: Path) -> Callable[[Edit], str]:
    """A function that edits a copy of the tiny bundle and returns its identity."""

    def identity(edit: Edit) -> str:
        copy = Bundle(Path(shutil.copytree(float_bundle.path, tmp_path / "edited")), float_bundle.manifest)
        _with_statistics(lambda table: table.update(action2=dict(table["action"], mean=[0, 0])))(copy)
        return policy_identity(seal(copy.path, edit(copy)))

    return identity


@pytest.mark.parametrize("name", DIFFERENT)
def test_what_changes_behaviour_changes_the_identity(edited, float_bundle, name):
    assert edited(DIFFERENT[name]) != policy_identity(float_bundle)


@pytest.mark.parametrize("name", SAME)
def test_what_does_not_change_behaviour_does_not(edited, float_bundle, name):
    assert edited(SAME[name]) == policy_identity(float_bundle)


def test_all_kinds_of_edits_have_identities_of_their_own(float_bundle, tmp_path):
    found = set()
    for number, edit in enumerate(DIFFERENT.values()):
        copy = Bundle(Path(shutil.copytree(float_bundle.path, tmp_path / str(number))), float_bundle.manifest)
        _with_statistics(lambda table: table.update(action2=dict(table["action"], mean=[0, 0])))(copy)
        found.add(policy_identity(seal(copy.path, edit(copy))))
    assert len(found) == len(DIFFERENT)


def test_a_quantized_bundle_is_another_policy(float_bundle, int8_bundle):
    assert policy_identity(float_bundle) != policy_identity(int8_bundle)


def test_a_renamed_statistics_file_is_the_same_policy(float_bundle, copied):
    bundle = copied(float_bundle)
    (bundle.path / "assets/statistics.json").rename(bundle.path / "assets/training.json")
    spec = bundle.manifest.spec
    renamed = [
        tuple(replace(tensor, statistics=tensor.statistics.replace("statistics.", "training.")) for tensor in tensors)
        for tensors in (spec.inputs, spec.outputs)
    ]
    manifest = replace(bundle.manifest, spec=replace(spec, inputs=renamed[0], outputs=renamed[1]))
    assert policy_identity(seal(bundle.path, manifest)) == policy_identity(float_bundle)


def test_weights_beside_a_graph_are_part_of_it(float_bundle, copied):
    bundle = copied(float_bundle)
    model = onnx.load(bundle.path / "graphs/main.onnx")
    onnx.save(model, bundle.path / "graphs/main.onnx", save_as_external_data=True, location="w.bin", size_threshold=0)
    before = policy_identity(seal(bundle.path, bundle.manifest))
    content = bytearray((bundle.path / "graphs/w.bin").read_bytes())
    content[0] ^= 1
    (bundle.path / "graphs/w.bin").write_bytes(content)
    assert policy_identity(seal(bundle.path, bundle.manifest)) != before


def test_a_field_that_the_spec_gains_later_is_part_of_it(float_bundle, monkeypatch):
    before = policy_identity(float_bundle)
    plain = TensorSpec.to_dict
    monkeypatch.setattr(TensorSpec, "to_dict", lambda tensor: {**plain(tensor), "image": {"channels": "bgr"}})
    assert policy_identity(float_bundle) != before


def test_what_becomes_of_a_frame_is_part_of_it(float_bundle):
    resize = ImageStep("resize", (8, 8))
    images = [None, Image(layout="hwc", steps=(resize,)), Image(frame="bgr", layout="hwc", steps=(resize,)),
              Image(layout="hwc", like="opencv", steps=(resize,)), Image(layout="hwc", range=(0, 1), steps=(resize,)),
              Image(layout="hwc", steps=(replace(resize, filter="nearest"),)),
              Image(layout="hwc", mean=(0.5,), std=(0.25,), steps=(resize,))]  # fmt: skip
    edits = [_with_tensor("inputs", 0, image=image, dtype="float32") for image in images]
    found = {policy_identity(replace(float_bundle, manifest=edit(float_bundle))) for edit in edits}
    assert len(found) == len(images)


def test_source_bundles_have_one_by_code_weights_and_spec(source_bundle, copied):
    bundle = copied(source_bundle)
    assert policy_identity(bundle) == policy_identity(source_bundle)
    code = {**bundle.manifest.source["code"], "policy.py": "0" * 64}
    other = replace(bundle.manifest, source={**bundle.manifest.source, "code": code})
    assert policy_identity(replace_manifest(bundle, other)) != policy_identity(source_bundle)


def test_the_runtime_exposes_it(float_bundle):
    assert load(float_bundle.path).identity == policy_identity(float_bundle)


def test_missing_statistics_are_an_error(float_bundle, copied):
    bundle = copied(float_bundle)
    (bundle.path / "assets/statistics.json").write_text('{"action": {"mean": [0, 0], "std": [1, 1]}}')
    with pytest.raises(SpecError, match="proprio"):
        policy_identity(seal(bundle.path, bundle.manifest))


def test_the_identity_of_a_written_bundle_stays(tmp_path):
    """A change of this value changes the identity of every policy: ``FORMAT`` then goes up."""
    (tmp_path / "main.onnx").write_bytes(b"")
    tensor, action = TensorSpec("state", (1, 2), unit="m"), TensorSpec("action", (1, 2), labels=("x", "y"))
    spec, program = PolicySpec((tensor,), (action,), 10), (ProgramStep("main", {"x": "state"}, {"y": "action"}),)
    empty = FileRecord(hashlib.sha256().hexdigest(), 0)
    manifest = Manifest("x", "1", spec, {"main": Graph("main.onnx")}, program, {"main.onnx": empty})
    value = "7a163c3c28711b90a48eee9ccdd3826b8458a76eb988b26da3241a0ed0cb6505"
    assert policy_identity(seal(tmp_path, manifest)) == f"sha256:{value}"
