"""Weight-only quantization end to end: from shards, from a bundle, in both layouts, with every method."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from _full import small_or_full
from _llama import make, write_llama
from safetensors.torch import load_file, save_file

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import FileRecord, Graph, Manifest
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.cli.inspect import describe
from vlatool.data import synthetic_observations
from vlatool.errors import BundleError, DataError, GraphError, OutputError, RecipeError, SourceError
from vlatool.quantize.weight_only import LOSS_REPORT, WEIGHTS_FILE, WeightOnly
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.samples._language import DecoderShape
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

SHAPE = DecoderShape(width=128, layers=2, heads=4, shared_heads=2, head_width=32, hidden=352)
TOKENS = 6


class Unquantized(WeightOnly):
    """Streams every tensor and quantizes none."""

    def select_nodes(self, names, bundle, ops=()):
        return set()


@pytest.fixture(scope="module")
def llama_template(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("llama") / "policy"
    write_llama(folder, shape=SHAPE, vocabulary=96, length=TOKENS, shard_bytes=300_000)
    ids = np.random.default_rng(5).integers(0, 96, (48, TOKENS))
    np.savez(folder / "calibration.npz", ids=ids)
    return folder


@pytest.fixture
def llama_dir(llama_template, tmp_path) -> Path:
    return Path(shutil.copytree(llama_template, tmp_path / "policy"))


def sourced(folder: Path, out: Path) -> Bundle:
    out.mkdir(parents=True)
    return TorchModule(policy=folder).run(None, out, Context()).bundle


@pytest.fixture(scope="module")
def llama(llama_template, tmp_path_factory) -> Bundle:
    return sourced(llama_template, tmp_path_factory.mktemp("llama-source") / "bundle")


@pytest.fixture(scope="module")
def llama_float(llama, tmp_path_factory) -> Bundle:
    """The same policy with no weight quantized: every graph in float32."""
    out = tmp_path_factory.mktemp("llama-float") / "bundle"
    out.mkdir()
    return Unquantized(embeddings="float32").run(llama, out, Context()).bundle


@pytest.fixture(scope="module")
def llama_int4(llama, tmp_path_factory) -> Bundle:
    return run_transform(WeightOnly(), llama, tmp_path_factory.mktemp("llama-int4") / "bundle", Context()).bundle


def actions(bundle: Bundle) -> np.ndarray:
    policy = load(bundle.path, threads=1)
    random = np.random.default_rng(3)
    return np.stack([policy.infer({"ids": random.integers(0, 96, (1, TOKENS))}).chunk for _ in range(32)])


def losses(bundle: Bundle) -> dict:
    return json.loads((bundle.path / LOSS_REPORT).read_text())


def kinds(bundle: Bundle) -> list[str]:
    model = onnx.load(bundle.path / "graphs/main.onnx", load_external_data=False)
    return [node.op_type for node in model.graph.node]


def test_the_streamed_graph_without_quantization_is_the_torch_module(llama_template, llama_float):
    described = llama_template / "policy.yaml"
    module = make(shape={**SHAPE.__dict__}, vocabulary=96, length=TOKENS)
    weights = {}
    for shard in sorted(described.parent.glob("*.safetensors")):
        weights.update(load_file(shard))
    assert len(list(described.parent.glob("*.safetensors"))) > 1
    module.load_state_dict({name: value.float() for name, value in weights.items()})
    random = np.random.default_rng(3)
    with torch.inference_mode():
        ids = [torch.from_numpy(random.integers(0, 96, (1, TOKENS))) for _ in range(32)]
        wanted = np.stack([module(each)[0].numpy() for each in ids])
    assert relative_error(actions(llama_float), wanted) < 1e-5


def test_from_shards_to_int4(llama, llama_int4, llama_float):
    assert Bundle.open(llama_int4.path) == llama_int4
    assert kinds(llama_int4).count("MatMulNBits") == 7 * 2 + 1
    assert "Transpose" in kinds(llama_int4)  # of heads; none of weights
    assert 0 < relative_error(actions(llama_int4), actions(llama_float)) < 0.35
    assert llama_int4.manifest.parent == llama.hash
    assert llama_int4.manifest.graphs["main"].precision["int4 weights"] > 0.9
    assert llama_int4.manifest.golden
    assert [step["stage"] for step in llama_int4.manifest.build] == ["sources.torch_module", "quantize.weight_only"]
    told = losses(llama_int4)
    assert len(told["layers"]) == 15
    assert 0.05 < told["mean"] <= told["max"] < 0.09
    assert llama_int4.manifest.made_by["weight_error"]["worst"] == told["worst"]
    model = onnx.load(llama_int4.path / "graphs/main.onnx", load_external_data=False)
    stored = {item.name: item for item in model.graph.initializer}
    assert stored["embedding.weight"].data_type == onnx.TensorProto.FLOAT16
    assert not [name for name, item in stored.items() if len(item.raw_data) > 1024]


def ort_quantized(source: Bundle, folder: Path, **options) -> onnx.ModelProto:
    """What ONNX Runtime's own quantizer makes of a float bundle, its transposed weights folded first."""
    from onnxruntime.quantization.matmul_nbits_quantizer import MatMulNBitsQuantizer

    onnx.save(onnx.load(source.path / "graphs/main.onnx"), folder / "whole.onnx")
    settings = onnxruntime.SessionOptions()
    settings.optimized_model_filepath = str(folder / "folded.onnx")
    settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    onnxruntime.InferenceSession(folder / "whole.onnx", settings, providers=["CPUExecutionProvider"])
    quantizer = MatMulNBitsQuantizer(onnx.load(folder / "folded.onnx"), block_size=32, accuracy_level=4, **options)
    quantizer.process()
    return quantizer.model.model


@pytest.mark.parametrize("symmetric", [False, True])
def test_int4_is_no_worse_than_onnx_runtimes_own_quantizer(llama_float, symmetric, tmp_path):
    model = ort_quantized(llama_float, tmp_path, is_symmetric=symmetric)
    assert [node.op_type for node in model.graph.node].count("MatMulNBits") == 15
    shutil.copytree(llama_float.path, tmp_path / "ort")
    (tmp_path / "ort/graphs/main.onnx").unlink()
    onnx.save(model, tmp_path / "ort/graphs/main.onnx")
    theirs = seal(tmp_path / "ort", replace(llama_float.manifest, golden=""))
    wanted = actions(llama_float)
    peer = relative_error(actions(theirs), wanted)
    plain, best = (
        run_transform(
            WeightOnly(symmetric=symmetric, search=search, embeddings="float32"),
            llama_float,
            tmp_path / name,
            Context(),
        ).bundle
        for name, search in (("plain", False), ("best", True))
    )
    assert relative_error(actions(plain), wanted) == pytest.approx(peer, rel=0.03)
    assert relative_error(actions(best), wanted) < peer
    assert losses(best)["mean"] < 0.975 * losses(plain)["mean"]


@pytest.mark.parametrize("options", [{"bits": 8}, {"bits": 8, "symmetric": True, "block": 128}], ids=str)
def test_int8_is_close_to_float(llama_float, tmp_path, options):
    made = run_transform(WeightOnly(**options), llama_float, tmp_path / "out", Context()).bundle
    assert 0 < relative_error(actions(made), actions(llama_float)) < 0.05


@pytest.mark.parametrize(
    "options",
    [
        {"symmetric": True},
        {"bits": 8},
        {"block": 64, "search": False},
        *small_or_full([], [{}, {"bits": 8, "symmetric": True}, {"block": 128}]),
    ],
    ids=str,
)
def test_both_layouts_mean_the_same(float_bundle, quantized, drift, options):
    """The tiny policy: weights as (inputs, outputs), 3 and 16 inputs padded to whole blocks, a Gemm with a bias."""
    blocks = quantized(WeightOnly(**options))
    standard = quantized(WeightOnly(layout="qdq", **options))
    assert "MatMulNBits" not in kinds(standard)
    assert kinds(standard).count("DequantizeLinear") == kinds(blocks).count("MatMulNBits") == 7
    assert drift(standard, blocks) < 1e-5
    assert 0 < drift(blocks) < (0.02 if options.get("bits") == 8 else 0.15)
    assert losses(blocks)["layers"] == losses(standard)["layers"]
    shares = [each.manifest.graphs["main"].precision for each in (blocks, standard)]
    assert shares[0] == shares[1]
    assert shares[0][f"int{options.get('bits', 4)} weights"] > 0.5
    beside = f" MB + {standard.manifest.files[WEIGHTS_FILE].bytes / 1e6:.2f} MB in {WEIGHTS_FILE}, opset 21, "
    assert any(beside in line for line in describe(standard))
    with pytest.raises(BundleError, match=r"\(weights\) already"):
        WeightOnly().check(standard, None)
    model = onnx.load(standard.path / "graphs/main.onnx")
    onnx.checker.check_model(model)
    assert next(entry.version for entry in model.opset_import if entry.domain == "") == 21


def test_a_bundle_with_external_data_is_streamed_too(float_bundle, copied, quantized, drift):
    bundle = copied(float_bundle)
    model = onnx.load(bundle.path / "graphs/main.onnx")
    whole = bundle.path / "graphs/main.onnx"
    onnx.save(model, whole, save_as_external_data=True, location="w.data", size_threshold=1024)
    external = seal(bundle.path, bundle.manifest)
    assert "graphs/w.data" in external.manifest.files
    made = quantized(WeightOnly(), external)
    assert drift(made, quantized(WeightOnly())) == 0
    assert sorted(path.name for path in (made.path / "graphs").iterdir()) == ["main.onnx", "weights.data"]


@pytest.mark.parametrize("method", ["gptq", "awq", "hqq"])
def test_every_method_gives_a_policy_near_float(llama_float, llama_int4, tmp_path, method):
    made = run_transform(WeightOnly(method=method), llama_float, tmp_path / "out", Context()).bundle
    wanted = actions(llama_float)
    assert 0 < relative_error(actions(made), wanted) < 1.3 * relative_error(actions(llama_int4), wanted)
    told = losses(made)
    assert len(told["layers"]) == 15
    if method != "hqq":
        assert all(0 < layer["product_error"] < 0.15 for layer in told["layers"])
        assert made.manifest.made_by["calibration"]["samples"] == 24


def test_calibrated_methods_take_bundles_and_the_qdq_layout(float_bundle, quantized, drift):
    blocks = quantized(WeightOnly(method="gptq"))
    assert drift(quantized(WeightOnly(method="gptq", layout="qdq")), blocks) < 1e-5
    assert 0 < drift(blocks) < 0.15
    scaled = quantized(WeightOnly(method="awq", layout="qdq"))
    assert 0 < drift(scaled) < 0.15
    assert drift(scaled, quantized(WeightOnly(method="awq"))) < 1e-5


def wide_policy(folder: Path) -> Bundle:
    """One product with 207 inputs, of which a sample gives one row."""
    (folder / "graphs").mkdir(parents=True)
    made = onnx.parser.parse_model(
        '<ir_version: 10, opset_import: ["" : 20]> g (float[1,207] x) => (float[1,64] y) { y = MatMul(x, w) }'
    )
    made.graph.node[0].name = "wide"
    weight = np.random.default_rng(0).standard_normal((207, 64)).astype(np.float32)
    made.graph.initializer.append(onnx.numpy_helper.from_array(weight, "w"))
    onnx.save(made, folder / "graphs/main.onnx")
    spec = PolicySpec((TensorSpec("x", (1, 207)),), (TensorSpec("y", (1, 64)),), 10.0)
    step = ProgramStep("main", {"x": "x"}, {"y": "y"})
    files = {"graphs/main.onnx": FileRecord("", 0)}
    graphs = {"main": Graph("graphs/main.onnx", {"float32": 1.0}, 20)}
    return seal(folder, Manifest("wide", "1", spec, graphs, (step,), files))


def test_states_are_taken_as_many_as_were_recorded_and_too_few_are_warned_of(tmp_path):
    bundle = wide_policy(tmp_path / "bundle")
    values = np.random.default_rng(1).standard_normal((400, 207)).astype(np.float32)
    values[:, ::3] = values[:, 1::3] + 0.1 * values[:, ::3]
    for count, options, taken in ((400, {}, 400), (400, {"samples": 20}, 20), (90, {}, 90)):
        np.savez(tmp_path / "mine.npz", x=values[:count])
        stage = WeightOnly(method="gptq", calibration=tmp_path / "mine.npz", **options)
        made = run_transform(stage, bundle, tmp_path / f"{count}{taken}", Context()).bundle
        assert made.manifest.made_by["calibration"]["samples"] == taken
        warned = [line for line in stage.summarize(made) if "warning: wide has 207 inputs" in line]
        assert [f"the samples give it {taken} rows" in line for line in warned] == ([] if taken >= 207 else [True])


def test_without_calibration_data_the_other_methods_are_named(llama_dir, tmp_path):
    (llama_dir / "calibration.npz").unlink()
    with pytest.raises(DataError, match="carries no calibration data") as caught:
        WeightOnly(method="gptq").check(sourced(llama_dir, tmp_path / "source"), None)
    assert "--method rtn or hqq" in caught.value.fix
    with pytest.raises(DataError, match=r"The calibration file .* does not exist"):
        WeightOnly(method="awq", calibration=tmp_path / "none.npz").check(None, None)


def test_globs_choose_the_layers(llama_float, tmp_path):
    stage = WeightOnly(include=("decoder.layers.*",), exclude=("*.feedforward.*",))
    made = run_transform(stage, llama_float, tmp_path / "out", Context()).bundle
    names = [layer["layer"] for layer in losses(made)["layers"]]
    assert len(names) == 8
    assert all("feedforward" not in name for name in names)
    with pytest.raises(RecipeError, match=r"No node matches 'decoder\.nothing'"):
        run_transform(WeightOnly(include=("decoder.nothing",)), llama_float, tmp_path / "other", Context())


def test_verification_by_layers_runs_nothing(llama, llama_int4, tmp_path):
    made = run_transform(WeightOnly(verify="layers"), llama, tmp_path / "out", Context()).bundle
    assert made.manifest.golden == ""
    assert Bundle.open(made.path) == made
    wanted = llama_int4.manifest.files
    assert {name: made.manifest.files[name] for name in (WEIGHTS_FILE, "graphs/main.onnx")} == {
        name: wanted[name] for name in (WEIGHTS_FILE, "graphs/main.onnx")
    }
    np.testing.assert_array_equal(actions(made), actions(llama_int4))


def test_an_existing_output_is_kept(llama, llama_int4):
    with pytest.raises(OutputError, match="exists already"):
        run_transform(WeightOnly(), llama, llama_int4.path, Context())
    Bundle.open(llama_int4.path)


def damaged(folder: Path, change) -> None:
    """Change the tensors of the shard that holds a query."""
    for shard in sorted(folder.glob("*.safetensors")):
        weights = load_file(shard)
        if "decoder.layers.1.query.weight" in weights:
            change(weights, "decoder.layers.1.query.weight")
            save_file(weights, shard)


def with_nan(weights, name):
    weights[name][3, 5] = float("nan")


def with_infinity(weights, name):
    weights[name][3, 5] = float("inf")


def transposed_twice(weights, name):
    weights[name] = weights[name][:, :64].contiguous()


def as_integers(weights, name):
    weights[name] = weights[name].to(torch.int8)


def renamed(weights, name):
    weights[f"{name}_2"] = weights.pop(name)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (with_nan, GraphError, "query.weight' in model-.* holds NaN or infinity"),
        (with_infinity, GraphError, "query.weight' in model-.* holds NaN or infinity"),
        (
            transposed_twice,
            SourceError,
            r"has the shape \[128, 64\]; the module built by the factory wants \[128, 128\]",
        ),
        (as_integers, SourceError, "is I8; weights may be F32, F16 or BF16"),
        (renamed, SourceError, "(does not hold it|No shard holds 'decoder.layers.1.query.weight')"),
    ],
)
def test_what_is_wrong_with_a_tensor_is_named(llama_dir, tmp_path, change, error, message):
    damaged(llama_dir, change)
    source = sourced(llama_dir, tmp_path / "source")
    with pytest.raises(error, match=message):
        run_transform(WeightOnly(), source, tmp_path / "out", Context())
    assert not (tmp_path / "out").exists()


def test_a_tensor_that_no_shard_holds_is_named(llama_dir, tmp_path):
    (llama_dir / "model.safetensors.index.json").unlink()
    damaged(llama_dir, renamed)
    with pytest.raises(SourceError, match=r"No shard holds '.*1\.query\.weight', which the module 'main' needs"):
        run_transform(WeightOnly(), sourced(llama_dir, tmp_path / "source"), tmp_path / "out", Context())


def test_a_policy_that_loads_its_weights_itself_is_exported_first(source_bundle, tmp_path):
    with pytest.raises(BundleError, match="names no weights to stream") as caught:
        run_transform(WeightOnly(), source_bundle, tmp_path / "out", Context())
    assert "vlatool export" in caught.value.fix


@pytest.mark.parametrize("options", [{"bits": 3}, {"block": 48}, {"method": "spqr"}, {"accuracy_level": 5}], ids=str)
def test_impossible_options_are_refused(options):
    with pytest.raises(RecipeError, match=next(iter(options))):
        build_stage("quantize.weight_only", options)


def test_the_observations_of_the_sample_fit_its_spec(llama):
    assert synthetic_observations(llama, 1)[0]["ids"].shape == (TOKENS,)


@pytest.mark.parametrize("pattern", ["/data/*.safetensors", "../*.safetensors", "[1]", "'**x'", ".", "x" * 300])
def test_weights_outside_the_folder_are_refused(llama_dir, pattern):
    described = llama_dir / "policy.yaml"
    described.write_text(described.read_text().replace("'*.safetensors'", pattern))
    with pytest.raises(SourceError, match="'weights' must be a glob inside the folder"):
        TorchModule(policy=llama_dir).check(None, None)
