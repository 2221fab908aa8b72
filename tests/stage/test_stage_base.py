import os
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from vlatool import __version__, registry
from vlatool.benchmark.latency import Latency
from vlatool.distill.policy import PolicyDistillation
from vlatool.errors import RecipeError
from vlatool.evaluate.recorded import Recorded
from vlatool.export.onnx import ExportOnnx
from vlatool.machine import instruction_sets
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.sources.onnx import OnnxFile
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context, Measure, Stage, Transform, source_of
from vlatool.stage.build import build_stage, stage_class, stage_kinds
from vlatool.stage.record import made_by


def test_a_stage_is_named_after_its_file():
    assert (StaticInt8.kind(), StaticInt8.name()) == ("quantize", "quantize.static_int8")
    assert stage_class("quantize.static_int8") is StaticInt8
    assert stage_class("quantize.static-int8") is StaticInt8


@pytest.mark.parametrize("name", [f"{kind}.{entry}" for kind in stage_kinds() for entry in registry.names(kind)])
def test_every_file_of_a_stage_folder_holds_a_stage_whose_options_have_descriptions(name):
    kind = stage_class(name)
    assert issubclass(kind, Transform | Measure)
    assert kind.name() == name
    assert kind.__doc__
    assert [field for field, info in kind.model_fields.items() if not info.description] == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("quantize.static_in8", "did you mean 'quantize.static_int8'"),
        ("static_int8", "Unknown stage 'static_int8'"),
        ("data.npz", "Unknown stage 'data.npz'"),
        ("quantize._graphs", "Unknown stage"),
        ("", "Unknown stage ''"),
    ],
)
def test_an_unknown_stage_gets_the_nearest_name(name, message):
    with pytest.raises(RecipeError, match=message):
        build_stage(name, {})


def test_options_are_those_that_differ_from_the_defaults_and_build_the_stage_again():
    stage = build_stage("quantize.static_int8", {"samples": 8, "method": "entropy", "calibration": "a.npz"})
    assert stage.options() == {"samples": 8, "method": "entropy", "calibration": "a.npz"}
    assert build_stage(stage.name(), stage.options()) == stage
    assert StaticInt8().options() == {}


def test_what_was_given_builds_the_stage_again_and_says_what_was_not():
    stage = build_stage("quantize.qat", {"layout": "ort", "steps": 8})
    again = build_stage(stage.name(), stage.model_copy(update={"batch": 2}).explicit_options())
    assert again == stage.model_copy(update={"batch": 2})
    assert again.model_fields_set == {"layout", "steps", "batch"}
    assert build_stage("quantize.qat", {}).explicit_options() == {}


def test_every_wrong_option_is_listed():
    with pytest.raises(RecipeError) as caught:
        build_stage("quantize.static_int8", {"samples": 0, "methode": "minmax", "activations": "int4"})
    assert caught.value.message.startswith("stage quantize.static_int8: ")
    assert "samples = 0: input should be greater than or equal to 1" in caught.value.message
    assert "unknown option 'methode'; did you mean 'method'" in caught.value.message
    assert "activations = 'int4'" in caught.value.message


@pytest.mark.parametrize("given", [float("nan"), 5])
def test_a_number_outside_its_range_is_told_both_ends(given: float):
    with pytest.raises(RecipeError, match=rf"learning_rate = {given}: input should be .*; allowed: above 0, at most 1"):
        build_stage("distill.policy", {"learning_rate": given})


def test_a_truth_value_is_no_number():
    with pytest.raises(RecipeError, match="samples = True: input should be a number, not a truth value"):
        build_stage("quantize.static_int8", {"samples": True})


def test_a_missing_option_is_named():
    with pytest.raises(RecipeError, match=r"policy = .*field required"):
        build_stage("sources.torch_module", {})


def test_a_stage_is_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        StaticInt8().samples = 3  # type: ignore[misc]


def test_the_key_follows_options_and_source_and_nothing_else():
    keys = [DynamicInt8().key("a"), DynamicInt8(per_channel=False).key("a"), DynamicInt8().key("b")]
    assert len(set(keys)) == 3
    assert DynamicInt8().key("a") == keys[0]
    assert all(len(key) == 16 and int(key, 16) >= 0 for key in keys)


def test_the_key_of_a_training_is_the_same_in_other_processes_and_folders(tmp_path: Path):
    code = "from vlatool.distill.policy import PolicyDistillation as Stage; print(Stage(steps=3).key('a'))"
    for seed, folder in (("0", tmp_path), ("7", Path.cwd())):
        other = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(folder)}
        found = subprocess.run([sys.executable, "-c", code], env=other, cwd=folder, capture_output=True, check=True)
        assert found.stdout.decode().strip() == PolicyDistillation(steps=3).key("a")


def test_an_option_that_another_version_does_not_have_is_part_of_the_key_even_by_default(monkeypatch):
    class Newer(DynamicInt8):
        shard: bool = False

    monkeypatch.setattr(Newer, "name", DynamicInt8.name)
    assert Newer().options() == DynamicInt8().options()
    assert Newer().key("a") != DynamicInt8().key("a")


def test_the_key_follows_what_openvino_computes_in_and_that_of_an_export_does_not(monkeypatch):
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    stages = (StaticInt8(), Latency(), Recorded(), ExportOnnx())
    keys: list[list[str]] = []
    for features, told in (
        (["avx2", "avx512_vnni"], ""),
        (["avx2", "avx512_vnni"], "AVX2"),
        (["avx2", "avx_vnni"], ""),
    ):
        monkeypatch.setattr(instruction_sets, "isa", lambda found=features: found)
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", told)
        keys.append([stage.key("a") for stage in stages])
    assert [len(set(each)) for each in zip(*keys, strict=True)] == [3, 3, 3, 1]


def test_the_key_follows_what_an_engine_beside_the_processor_is_built_against(monkeypatch):
    stages, drivers = (StaticInt8(), Latency(), ExportOnnx()), ("", "driver 1", "driver 1", "driver 2")
    keys: list[list[str]] = []
    for driver in drivers:
        monkeypatch.setattr(OpenvinoSession, "identity", classmethod(lambda _, found=driver: found))
        keys.append([stage.key("a") for stage in stages])
    assert keys[1] == keys[2]
    assert [len(set(each)) for each in zip(*keys, strict=True)] == [3, 3, 1]


def test_the_key_follows_the_content_of_files_and_not_their_age(tmp_path: Path):
    data = tmp_path / "c.npz"
    stage = StaticInt8(calibration=data)
    absent = stage.key("a")
    data.write_bytes(b"one")
    one = stage.key("a")
    data.write_bytes(b"two")
    two = stage.key("a")
    data.write_bytes(b"one")
    assert len({absent, one, two}) == 3
    assert stage.key("a") == one


def test_the_key_of_a_torch_source_follows_its_code_weights_statistics_and_data(policy_dir: Path):
    seen = {TorchModule(policy=policy_dir).key("")}
    for name in ("policy.py", "policy.yaml", "weights.safetensors", "statistics.json", "calibration.npz"):
        with (policy_dir / name).open("ab") as stream:
            stream.write(b"\n")
        seen.add(TorchModule(policy=policy_dir).key(""))
    assert len(seen) == 6


@pytest.mark.parametrize("named", ["folder", "file"])
def test_the_key_of_an_onnx_source_follows_its_description_and_what_that_names(
    policy_dir: Path, onnx_file: Path, named: str
):
    stage = OnnxFile(model=onnx_file, policy=policy_dir if named == "folder" else policy_dir / "policy.yaml")
    seen = {stage.key("")}
    for name in ("policy.yaml", "statistics.json", "vocabulary.json", "calibration.npz"):
        with (policy_dir / name).open("ab") as stream:
            stream.write(b"\n")
        seen.add(stage.key(""))
    assert len(seen) == 5


def test_a_package_that_is_not_installed_does_not_break_the_key():
    class Odd(Stage):
        packages = ("no-such-distribution",)

    assert len(Odd().key("a")) == 16


def test_made_by_leaves_out_what_is_not_installed(monkeypatch):
    monkeypatch.setattr(DynamicInt8, "packages", ("numpy", "no-such-distribution"))
    assert list(made_by(DynamicInt8())["versions"]) == ["numpy"]


def test_made_by_names_stage_options_versions_and_seed():
    made = made_by(DynamicInt8(per_channel=False), seed=3)
    assert (made["vlatool"], made["stage"], made["seed"]) == (__version__, "quantize.dynamic_int8", 3)
    assert made["options"] == {"per_channel": False}
    assert set(made["versions"]) == set(DynamicInt8.packages)
    assert "seed" not in made_by(DynamicInt8())


def test_a_context_may_be_silent():
    Context().progress("working", 0.5)


def test_a_plain_stage_checks_nothing_and_reads_nothing():
    class Plain(Stage):
        pass

    Plain().check(None, None)
    assert Plain().inputs() == ()


def test_a_stage_without_a_source_says_how_to_begin(source_bundle):
    assert source_of(source_bundle, "export.onnx") is source_bundle
    with pytest.raises(RecipeError, match=r"export.onnx needs a bundle to start from; begin the recipe"):
        source_of(None, "export.onnx")


def test_options_that_were_given_stay():
    assert StaticInt8(layout="ort").unless_given({"layout": "qdq", "attention": True}).options() == {"attention": True}
