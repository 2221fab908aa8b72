from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.data import recorded_observations
from vlatool.errors import GraphError, RecipeError, SourceError, SpecError
from vlatool.export.onnx import ExportOnnx
from vlatool.export.opset import Opset
from vlatool.hardware.profile import load_profile
from vlatool.measurement.jobs import LatencyJob
from vlatool.measurement.worker import measure, open_policy
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.quantize.qat import Qat
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

PLAIN_YAML = """\
name: plain
source: policy.py:make
spec:
  inputs: [{name: x, shape: [1, 3]}]
  outputs: [{name: y, shape: [1, 2]}]
  control_hz: 10
"""
PLAIN_PY = """\
import torch
from torch import nn

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.linear = nn.Linear(3, 2)

    def forward(self, x):
        BODY

def make():
    return Policy()
"""
FLOW_YAML = """\
name: flow
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 3]}]
  outputs: [{name: action, shape: [1, 4, 2]}]
  control_hz: 10
  chunk: 4
program:
  - {graph: encode, feeds: {state: state}, gives: {memory: memory}}
  - graph: denoise
    feeds: {memory: memory, noisy: noisy, time: time}
    gives: {cleaner: action}
    repeat: 3
    carry: {action: noisy}
    schedule: {time: [0.0, 0.25, 0.5]}
    noise: {noisy: {shape: [1, 4, 2], distribution: normal}}
"""
FLOW_PY = """\
import torch
from torch import nn

class Encode(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(3, 8)

    def forward(self, state):
        return torch.tanh(self.linear(state))

class Denoise(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(8 + 2 + 1, 2)

    def forward(self, memory, noisy, time):
        context = torch.cat([memory, time[None]], 1)[:, None].expand(1, 4, 9)
        return noisy - (1 - time) * self.linear(torch.cat([context, noisy], 2))

def make():
    torch.manual_seed(0)
    return {"encode": Encode(), "denoise": Denoise()}
"""


@pytest.fixture
def source(tmp_path: Path) -> Callable[..., Bundle]:
    """A function that writes a policy and gives its source bundle."""

    def make(code: str, description: str = PLAIN_YAML) -> Bundle:
        folder, out = tmp_path / "policy", tmp_path / "source"
        folder.mkdir()
        out.mkdir()
        (folder / "policy.py").write_text(code)
        (folder / "policy.yaml").write_text(description)
        return TorchModule(policy=folder).run(None, out, Context()).bundle

    return make


@pytest.fixture
def plain(source) -> Callable[[str], Bundle]:
    """A function that gives the source bundle of a policy whose ``forward`` is the given body."""
    return lambda body: source(PLAIN_PY.replace("BODY", body.replace("\n", "\n        ")))


def export(bundle: Bundle, out: Path, **options: object) -> Bundle:
    out.mkdir()
    return ExportOnnx(**options).run(bundle, out, Context()).bundle


def test_the_exported_policy_gives_what_torch_gives(source_bundle, float_bundle):
    torch_side, onnx_side = torch_policy(source_bundle), load(float_bundle.path, threads=1)
    for observation in recorded_observations(source_bundle, 6):
        wanted, got = torch_side.infer(observation), onnx_side.infer(observation)
        np.testing.assert_allclose(got.chunk, wanted.chunk, rtol=1e-3, atol=1e-5)
        assert got.labels == wanted.labels
    assert torch_side.engine == "torch eager"


def test_the_exported_bundle_is_complete(source_bundle, float_bundle):
    assert Bundle.open(float_bundle.path) == float_bundle
    graph = float_bundle.manifest.graphs["main"]
    assert (graph.file, graph.opset, graph.precision) == ("graphs/main.onnx", 20, {"float32": 1.0})
    assert float_bundle.manifest.golden in float_bundle.manifest.files
    assert not (float_bundle.path / "graphs/main.onnx.data").exists()
    model = onnx.load(float_bundle.path / "graphs/main.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [value.name for value in model.graph.input] == ["image", "proprio", "instruction"]
    assert [value.name for value in model.graph.output] == ["action"]


def test_two_exports_give_equal_bytes(source_bundle, float_bundle, tmp_path: Path):
    again = export(source_bundle, tmp_path / "again")
    assert again.hash == float_bundle.hash
    assert hash_file(again.path / "graphs/main.onnx") == hash_file(float_bundle.path / "graphs/main.onnx")


def test_the_graph_holds_no_paths_of_this_machine(float_bundle, policy_template):
    content = (float_bundle.path / "graphs/main.onnx").read_bytes()
    for part in (b"site-packages", b"policy.py", b".venv", b"Traceback", str(policy_template).encode(), b"/tmp/"):
        assert part not in content


def test_a_program_of_two_graphs_with_repeat_carry_schedule_and_noise(source, tmp_path: Path):
    bundle = source(FLOW_PY, FLOW_YAML)
    made = export(bundle, tmp_path / "out")
    assert set(made.manifest.graphs) == {"encode", "denoise"}
    torch_side, onnx_side = torch_policy(bundle), load(made.path, threads=1)
    noise = {"noisy": np.random.default_rng(0).normal(size=(1, 4, 2)).astype(np.float32)}
    observation = {"state": np.array([0.1, -0.5, 2.0], np.float32)}
    wanted = torch_side.infer(observation, noise=noise).chunk
    np.testing.assert_allclose(onnx_side.infer(observation, noise=noise).chunk, wanted, rtol=1e-4, atol=1e-6)
    seeded = [load(made.path, threads=1, seed=4).infer(observation).chunk for _ in range(2)]
    np.testing.assert_array_equal(*seeded)
    assert not np.allclose(seeded[0], wanted)


def test_eager_torch_and_the_graphs_draw_the_same_noise(source, tmp_path: Path):
    """A false alarm otherwise: two passes of a policy with noise answer alike, in torch as in the engine."""
    bundle = source(FLOW_PY, FLOW_YAML)
    made = export(bundle, tmp_path / "out")
    observation = {"state": np.array([0.1, -0.5, 2.0], np.float32)}
    job = LatencyJob((str(made.path), str(bundle.path)), iterations=40, warmup=1)
    contestants = [open_policy(path, job) for path in job.bundles]
    graphs, eager = (each.policy.infer(observation).chunk for each in contestants)
    np.testing.assert_allclose(graphs, eager, rtol=1e-4, atol=1e-6)
    found = measure(contestants, job, lambda what, share: None)
    assert [policy.answers.strays for policy in found.policies] == [0, 0]


def test_progress_is_told(plain, tmp_path: Path):
    told: list[str] = []
    (tmp_path / "out").mkdir()
    context = Context(progress=lambda what, share: told.append(what))
    ExportOnnx().run(plain("return self.linear(x)"), tmp_path / "out", context)
    assert "exporting main" in told


@pytest.mark.parametrize("opset", [13, 18, 23])
def test_another_opset(plain, tmp_path: Path, opset: int):
    made = export(plain("return torch.softmax(self.linear(x), -1)"), tmp_path / "out", opset=opset)
    assert made.manifest.graphs["main"].opset == opset
    opsets = {entry.domain: entry.version for entry in onnx.load(made.path / "graphs/main.onnx").opset_import}
    assert opsets[""] == opset


def test_the_opset_of_a_board_is_that_of_its_preferred_engine():
    assert ExportOnnx().on(load_profile("jetson-orin-nano-original")).opset == 17
    assert ExportOnnx(opset=18).on(load_profile("jetson-orin-nano-original")).opset == 18
    assert ExportOnnx().on(load_profile("jetson-orin-nano")) == ExportOnnx()
    stage = Opset().on(load_profile("jetson-orin-nano"))
    assert (stage.opset, stage.ir_version) == (20, 11)


def test_a_bundle_in_older_versions_gives_the_same_actions(plain, tmp_path: Path):
    bundle = export(plain("return torch.softmax(self.linear(x), -1)"), tmp_path / "new")
    result = run_transform(Opset(opset=17, ir_version=8), bundle, tmp_path / "old", Context())
    assert result.messages == ("main: opset 20 -> 17",)
    model = onnx.load(result.bundle.path / "graphs/main.onnx")
    assert (model.ir_version, result.bundle.manifest.graphs["main"].opset) == (8, 17)
    with pytest.raises(RecipeError, match="needs an opset or an IR version"):
        Opset().check(bundle, None)


def test_an_operator_that_an_older_opset_lacks_is_named(float_bundle, tmp_path: Path):
    with pytest.raises(GraphError, match="cannot be written in opset 17: it has Gelu") as caught:
        run_transform(Opset(opset=17), float_bundle, tmp_path / "old", Context())
    assert "vlatool export POLICY --opset" in caught.value.fix


def test_large_weights_go_beside_the_graph(source_bundle, tmp_path: Path, monkeypatch):
    import vlatool.export.onnx

    monkeypatch.setattr(vlatool.export.onnx, "BESIDE_BYTES", 8)
    made = export(source_bundle, tmp_path / "out")
    assert made.manifest.files["graphs/main.onnx.data"].bytes > 1000
    assert load(made.path, threads=1).golden_error == pytest.approx(0, abs=1e-6)


def test_weights_that_changed_since_the_source_was_made(policy_dir: Path, tmp_path: Path):
    (tmp_path / "source").mkdir()
    bundle = TorchModule(policy=policy_dir).run(None, tmp_path / "source", Context()).bundle
    with (policy_dir / "weights.safetensors").open("r+b") as stream:
        stream.seek(-1, 2)
        stream.write(b"\x01")
    with pytest.raises(SourceError, match=r"weights.safetensors has changed since") as caught:
        export(bundle, tmp_path / "out")
    assert "start again" in caught.value.fix


def test_code_that_is_gone(plain, tmp_path: Path):
    bundle = plain("return self.linear(x)")
    (tmp_path / "policy/policy.py").unlink()
    with pytest.raises(SourceError, match=r"policy.py has changed"):
        load_modules(bundle)


def test_modules_are_in_evaluation_mode(source_bundle):
    assert not any(module.training for module in load_modules(source_bundle)["main"].modules())


def test_a_bundle_of_an_onnx_file_has_nothing_to_export(float_bundle, tmp_path: Path):
    from dataclasses import replace

    bundle = Bundle(float_bundle.path, replace(float_bundle.manifest, source={}))
    with pytest.raises(SourceError, match="was not made from a torch policy"):
        export(bundle, tmp_path / "out")


def test_an_export_needs_a_source(tmp_path: Path):
    with pytest.raises(RecipeError, match=r"export.onnx needs a bundle"):
        run_transform(ExportOnnx(), None, tmp_path / "out", Context())


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("raise RuntimeError('no camera')", r"fails on an observation that fits its spec: RuntimeError: no camera"),
        (
            "raise RuntimeError",
            r"fails on an observation that fits its spec: RuntimeError: +\(given x \[1, 3\] float32\)",
        ),
        ("return self.linear(x[:, :2])", r"fails on an observation .*given x \[1, 3\] float32"),
        ("return self.linear(x), x", "gives 2 outputs; the program says y"),
        ("return ()", "gives 0 outputs"),
    ],
)
def test_a_module_that_fails_or_gives_another_number_of_outputs(plain, tmp_path: Path, body, message):
    with pytest.raises(SourceError, match=message):
        export(plain(body), tmp_path / "out")


@pytest.mark.parametrize("body", ["return {'y': self.linear(x)}", "return None", "return 3.0"])
def test_a_module_that_gives_no_tensor_is_a_source_error_and_no_traceback(plain, tmp_path: Path, body):
    with pytest.raises(SourceError, match="tensor"):
        export(plain(body), tmp_path / "out")


def test_control_flow_on_data_is_told_without_a_traceback(plain, tmp_path: Path):
    body = "if x.sum() > 0:\n    return self.linear(x)\nreturn self.linear(x) * 2"
    with pytest.raises(GraphError, match="torch cannot export the graph 'main': ") as caught:
        export(plain(body), tmp_path / "out")
    assert "control flow" in caught.value.message
    assert len(caught.value.message.splitlines()) == 1


EXPORTED_PY = (
    PLAIN_PY.replace("BODY", "return self.linear(torch.relu(x))").replace("def make", "def plain")
    + """
from pathlib import Path

def make():
    program = torch.export.export(plain().eval(), (torch.zeros(1, 3),))
    file = Path(__file__).with_name("policy.pt2")
    torch.export.save(program, file)
    program = torch.export.load(file)
    return FORM
"""
)


@pytest.mark.parametrize("form", ["program", "program.module()", "nn.Sequential(program.module())"])
def test_a_program_of_torch_export_is_a_policy(source, tmp_path: Path, form: str):
    bundle = source(EXPORTED_PY.replace("FORM", form))
    made = export(bundle, tmp_path / "out")
    observation = {"x": np.array([1.0, -2.0, 3.0], np.float32)}
    wanted = torch_policy(bundle).infer(observation).chunk
    np.testing.assert_allclose(load(made.path, threads=1).infer(observation).chunk, wanted, rtol=1e-5)
    assert np.abs(wanted).sum() > 0


def test_random_numbers_in_forward_are_seen(plain, tmp_path: Path):
    with pytest.raises(GraphError, match="draws random numbers, once an inference") as caught:
        export(plain("return self.linear(x) + torch.rand(1, 2)"), tmp_path / "out")
    assert "distribution: uniform" in caught.value.fix


@pytest.mark.parametrize("effect", ["* self.linear.turn", "* (1 if self.linear.turn < 5000 else 2)"])
def test_state_that_forward_keeps_is_seen(plain, tmp_path: Path, effect: str):
    body = f"self.linear.turn = getattr(self.linear, 'turn', 0) + 1\nreturn self.linear(x) {effect}"
    with pytest.raises(SourceError, match=r"changes 'linear\.turn' from call to call") as caught:
        export(plain(body), tmp_path / "out")
    assert "'keep' in the program" in caught.value.fix


def test_a_factory_that_gives_no_module(source, tmp_path: Path):
    with pytest.raises(SourceError, match="gave a int for 'main'; wanted a torch module"):
        export(source("def make():\n    return 3\n"), tmp_path / "out")


def test_a_factory_that_lacks_a_graph_of_the_program(source, tmp_path: Path):
    code = FLOW_PY.replace('"denoise": ', '"denoiser": ')
    with pytest.raises(SourceError, match="runs 'denoise', which the factory does not give; did you mean 'denoiser'"):
        export(source(code, FLOW_YAML), tmp_path / "out")


def test_options_outside_the_range_are_refused():
    with pytest.raises(RecipeError, match=r"opset = 6.*tolerance = 0"):
        build_stage("export.onnx", {"opset": 6, "tolerance": 0})


def test_the_shapes_of_an_onnx_file_are_refused_for_a_torch_policy(source_bundle):
    with pytest.raises(RecipeError, match="ONNX file") as caught:
        ExportOnnx(shape=("x=1",)).check(source_bundle, None)
    assert caught.value.fix


def test_a_scalar_of_a_torch_policy_is_an_input_like_others(tmp_path: Path):
    (tmp_path / "policy.py").write_text(
        "import torch\nfrom torch import nn\n\n\nclass Net(nn.Module):\n    def __init__(self):\n"
        "        super().__init__()\n        self.net = nn.Linear(16, 6)\n\n"
        "    def forward(self, state, rate):\n        return self.net(state * rate), 2 * rate\n\n\n"
        "def make():\n    return Net()\n"
    )
    (tmp_path / "policy.yaml").write_text(
        "name: net\nsource: policy.py:make\ncalibration: c.npz\nspec:\n"
        "  inputs: [{name: state, shape: [1, 16]}, {name: rate, shape: []}]\n"
        "  outputs: [{name: action, shape: [1, 6]}, {name: twice, shape: []}]\n  control_hz: 10\n"
    )
    random = np.random.default_rng(0)
    recorded = {
        "state": random.normal(size=(64, 16)).astype(np.float32),
        "rate": np.linspace(1, 2, 64, dtype=np.float32),
    }
    np.savez(tmp_path / "c.npz", **recorded)
    bundles = {}
    for name, stage in (("s", TorchModule(policy=tmp_path)), ("e", ExportOnnx()), ("q", StaticInt8())):
        (tmp_path / name).mkdir()
        bundles[name] = stage.run(next(reversed(bundles.values()), None), tmp_path / name, Context()).bundle
    wide, narrow = (load(bundles[name].path, threads=1) for name in "eq")
    for rate in (1.25, np.float32(1.5), np.array([1.75])):
        observation = {"state": recorded["state"][0], "rate": rate}
        assert wide.infer(observation).outputs["twice"] == 2 * np.float32(np.squeeze(rate))
        assert relative_error(narrow.infer(observation).chunk, wide.infer(observation).chunk) < 0.1
    with pytest.raises(RecipeError, match="'rate' has no axes"):
        Qat().check(bundles["s"], None)


FLOATS = {
    "bfloat16": "self.net(obs.bfloat16())", "float16": "self.net(obs.half())", "float64": "self.net(obs.double())",
}  # fmt: skip


@pytest.mark.parametrize("name", FLOATS)
def test_a_policy_in_another_float_is_exported_in_float32_and_told(tmp_path: Path, name: str):
    (tmp_path / "policy.py").write_text(
        "import torch\nfrom torch import nn\n\n\nclass Net(nn.Module):\n    def __init__(self):\n"
        "        super().__init__()\n        torch.manual_seed(0)\n"
        f"        self.net = nn.Linear(17, 6).to(torch.{name})\n\n"
        f"    def forward(self, obs):\n        return {FLOATS[name]}{'' if name == 'bfloat16' else '.float()'}\n\n\n"
        "def make():\n    return Net()\n"
    )
    (tmp_path / "policy.yaml").write_text(
        "name: net\nsource: policy.py:make\nspec:\n  inputs: [{name: obs, shape: [1, 17]}]\n"
        "  outputs: [{name: action, shape: [1, 6]}]\n  control_hz: 10\n"
    )
    folders = [tmp_path / "source", tmp_path / "out"]
    for folder in folders:
        folder.mkdir()
    source = TorchModule(policy=tmp_path).run(None, folders[0], Context()).bundle
    result = ExportOnnx().run(source, folders[1], Context())
    assert f"layers compute in {name}; the graph is converted to float32" in result.messages[0]
    graph = onnx.load(result.bundle.path / "graphs/main.onnx").graph
    assert {tensor.data_type for tensor in graph.initializer} == {1}
    assert result.bundle.manifest.graphs["main"].precision == {"float32": 1.0}


def test_the_error_of_a_tight_tolerance_names_the_number(source_bundle, tmp_path: Path):
    with pytest.raises(GraphError, match=r"relative L2 error .*, allowed 1e-12"):
        export(source_bundle, tmp_path / "out", tolerance=1e-12)


def test_the_exporter_leaves_logging_and_outputs_alone(plain, tmp_path: Path, capfd):
    import logging

    before = logging.getLogger("torch.onnx").level
    export(plain("return self.linear(x)"), tmp_path / "out")
    assert logging.getLogger("torch.onnx").level == before
    assert capfd.readouterr() == ("", "")


def test_the_golden_action_is_that_of_the_exported_graph(float_bundle, source_bundle):
    with np.load(float_bundle.path / "golden/golden.npz") as golden:
        observation = recorded_observations(source_bundle, 24)[0]
        got = torch_policy(source_bundle).infer(observation).outputs["action"]
        assert relative_error(got, golden["out.action"][0]) < 1e-4


@pytest.mark.parametrize(
    ("output", "body", "told"),
    [
        ("{name: y, shape: [1, 8, 7]}", "x.repeat(1, 38)[:, :112].reshape(1, 8, 14)", r"float32 \[1, 8, 14\]"),
        ("{name: y, shape: [1, 8, 7]}", "x.repeat(1, 38)[:, :112]", r"float32 \[1, 112\]"),
        ("{name: y, shape: [1, 2]}", "self.linear(x).double()", r"float64 \[1, 2\]"),
        ("{name: y, shape: [1, 3], kind: discrete, labels: [a, b, c]}", "self.linear(x)", r"float32 \[1, 2\]"),
    ],
    ids=["wider", "flat", "float64", "two logits"],
)
def test_a_module_that_gives_something_else_than_its_spec_declares_is_not_exported(
    source, tmp_path: Path, output, body, told
):
    chunk = "  chunk: 8\n" if "8, 7" in output else ""
    description = PLAIN_YAML.replace("{name: y, shape: [1, 2]}", output) + chunk
    bundle = source(PLAIN_PY.replace("BODY", f"return {body}"), description)
    with pytest.raises(GraphError, match=f"The torch module gives 'y' as {told}; the spec declares") as caught:
        export(bundle, tmp_path / "out")
    assert ("cast it" in caught.value.fix) == ("float64" in told)


def test_a_chunk_that_the_shape_does_not_hold_is_not_exported(source, tmp_path: Path):
    bundle = source(PLAIN_PY.replace("BODY", "return self.linear(x)"), PLAIN_YAML + "  chunk: 8\n")
    with pytest.raises(SpecError, match="chunk 8; the shape"):
        export(bundle, tmp_path / "out")


NORMALISED_PY = """\
import torch
from torch import nn

class Cnn(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv1, self.bn1 = nn.Conv1d(1, 4, 3), nn.BatchNorm1d(4)
        self.conv2, self.bn2 = nn.Conv1d(4, 4, 1), nn.BatchNorm1d(4)

    def forward(self, x):
        return self.bn2(self.conv2(torch.relu(self.bn1(self.conv1(x)))))

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.cnn, self.head = Cnn(), nn.Linear(4, 2)

    def forward(self, x):
        return self.head(self.cnn(x[:, None]).flatten(1))

def make():
    return Policy()
"""


@pytest.fixture(scope="module")
def normalised(tmp_path_factory) -> Bundle:
    """A policy whose exporter folds the BatchNorms into the convolutions before them."""
    folder = tmp_path_factory.mktemp("normalised")
    described = PLAIN_YAML + "parts:\n  first: ['cnn.bn1']\n  second: ['cnn.conv2']\n"
    (folder / "policy.yaml").write_text(described)
    (folder / "policy.py").write_text(NORMALISED_PY)
    np.savez(folder / "calibration.npz", x=np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32))
    for name in ("source", "float"):
        (folder / name).mkdir()
    source = TorchModule(policy=folder).run(None, folder / "source", Context()).bundle
    return ExportOnnx().run(source, folder / "float", Context()).bundle


def test_a_layer_keeps_its_name_when_a_normalisation_is_folded_into_it(normalised):
    names = [node.name for node in onnx.load(normalised.path / "graphs/main.onnx").graph.node]
    assert {"cnn.conv1/Conv", "cnn.conv2/Conv", "head/Gemm"} <= set(names)
    assert not [name for name in names if "bn" in name]


@pytest.mark.parametrize(
    "options",
    [
        {"exclude": ("cnn.conv1*",)},
        {"exclude": ("cnn.conv1",)},
        {"exclude": ("cnn.bn1*",)},
        {"exclude": ("cnn.bn1",)},
        {"exclude": ("cnn.bn1/Conv",)},
        {"include": ("*bn2", "head")},
        {"exclude": ("cnn.bn1",), "include": ("cnn.*", "head")},
    ],
    ids=str,
)
def test_a_folded_layer_is_met_by_both_of_its_names(normalised, options):
    names = ["cnn.conv1/Conv", "cnn.conv2/Conv", "head/Gemm"]
    assert StaticInt8(**options).select_nodes(names, normalised) == {"cnn.conv2/Conv", "head/Gemm"}


@pytest.mark.parametrize(("part", "layer"), [("first", "cnn.conv1/Conv"), ("second", "cnn.conv2/Conv")])
def test_a_part_may_name_either_of_them(normalised, part, layer):
    assert StaticInt8(parts=(part,)).select_nodes(["cnn.conv1/Conv", "cnn.conv2/Conv"], normalised) == {layer}


def test_a_pattern_that_meets_neither_is_refused_with_the_near_names(normalised):
    with pytest.raises(RecipeError, match=r"No node matches 'cnn.conf1'; did you mean 'cnn.conv1/Conv'\?"):
        StaticInt8(exclude=("cnn.conf1",)).select_nodes(["cnn.conv1/Conv", "head/Gemm"], normalised)


@pytest.mark.parametrize("body", ["x / (x - x)", "torch.log(-x.abs() - 1)", "x * float('nan')", "x.exp() * 1e39"])
def test_a_policy_that_answers_nan_at_export_is_blamed_itself(plain, tmp_path: Path, body: str):
    with pytest.raises(GraphError, match=r"The output 'y' is not finite \(the answer to observation 0\)\.") as caught:
        export(plain(f"return ({body})[:, :2]"), tmp_path / "out")
    assert caught.value.fix.startswith("correct the policy: ")
    assert "do not execute" not in caught.value.fix


def test_a_mismatch_names_the_node_and_its_module(tmp_path: Path) -> None:
    """A module that computes something else while it is exported."""
    body = """h = self.linear(x)
        return (h * 1.5 if torch.compiler.is_exporting() else h).tanh()"""
    (tmp_path / "policy.yaml").write_text(PLAIN_YAML)
    inner = "class Inner(nn.Module):\n    def __init__(self):\n        super().__init__()\n        "
    layer = "self.linear = nn.Linear(3, 2)"
    code = PLAIN_PY.replace("BODY", "return self.inner(x)").replace(layer, "self.inner = Inner()")
    inner += f"{layer}\n\n    def forward(self, x):\n        {body}\n\n"
    code = code.replace("class Policy", f"{inner}class Policy")
    (tmp_path / "policy.py").write_text(code)
    source = TorchModule(policy=tmp_path)
    (tmp_path / "source").mkdir()
    (tmp_path / "out").mkdir()
    bundle = source.run(None, tmp_path / "source", Context()).bundle
    with pytest.raises(GraphError, match=r"they differ from the node 'inner\.linear/Gemm' of the graph 'main' on"):
        ExportOnnx(exporter="dynamo").run(bundle, tmp_path / "out", Context())
