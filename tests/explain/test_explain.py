"""A policy with one layer that int8 ruins and one phase that bfloat16 ruins: explain names both, and the way out."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from typer.testing import CliRunner

from vlatool.bundle.bundle import Bundle, seal
from vlatool.cli import app
from vlatool.data import named_recording, recorded_observations
from vlatool.errors import BundleError, DataError
from vlatool.explain import Options, _Findings, _times, explain, explanation
from vlatool.explain._candidates import measure
from vlatool.explain._float_roundtrips import QuantizedGraph, fallbacks, with_times
from vlatool.explain._operators import GROUPS, profile, shares
from vlatool.explain._origin import command, observations_of, origin
from vlatool.machine.host import fingerprint
from vlatool.quantize.bfloat16 import Bfloat16
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.render import render
from vlatool.render.formats.terminal import TerminalRenderer
from vlatool.report import Report
from vlatool.runtime.policy import Policy
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

FRAGILE = "blocks.2"
POLICY_YAML = """\
schema: 1
name: fragile
version: 1.0.0
source: policy.py:make
spec:
  inputs:
    - {name: state, shape: [1, 24]}
    - {name: time, shape: [1, 1]}
  outputs:
    - {name: action, shape: [1, 4, 3], unit: [m, m, "1"], labels: [dx, dy, gripper]}
  control_hz: 10
  chunk: 4
"""
POLICY_PY = '''\
"""Four blocks; what the third one reads has one channel 1000 times as large as the others, which matter as much."""

import torch
from torch import nn

WIDTH = 48


class Block(nn.Module):
    def __init__(self, outlier):
        super().__init__()
        self.norm = nn.LayerNorm(WIDTH)
        self.fc = nn.Linear(WIDTH, WIDTH)
        self.register_buffer("scale", torch.ones(WIDTH))
        if outlier:
            self.scale[5] = 1000.0
            self.fc.weight.data[:, 5] /= 1000.0

    def forward(self, x):
        return x + torch.tanh(self.fc(self.norm(x) * self.scale))


class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.state = nn.Linear(24, WIDTH)
        self.time = nn.Linear(16, WIDTH)
        self.blocks = nn.Sequential(*(Block(index == 2) for index in range(4)))
        self.head = nn.Linear(WIDTH, 12)
        self.register_buffer("frequencies", torch.linspace(100.0, 700.0, 8))

    def forward(self, state, time):
        phase = time * self.frequencies
        x = self.state(state) + 3 * self.time(torch.cat([torch.sin(phase), torch.cos(phase)], -1))
        return self.head(self.blocks(x)).reshape(1, 4, 3)


def make():
    torch.manual_seed(0)
    return Policy().eval()
'''


def recording(count: int, seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {
        "state": random.standard_normal((count, 24)).astype(np.float32),
        "time": random.uniform(0, 1, (count, 1)).astype(np.float32),
    }


@pytest.fixture(scope="module")
def fragile(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The float32 bundle; read only."""
    from vlatool.export.onnx import ExportOnnx
    from vlatool.sources.torch_module import TorchModule

    folder = tmp_path_factory.mktemp("fragile")
    policy = folder / "policy"
    policy.mkdir()
    (policy / "policy.yaml").write_text(POLICY_YAML)
    (policy / "policy.py").write_text(POLICY_PY)
    np.savez(policy / "calibration.npz", **recording(24, 1))
    np.savez(policy / "evaluation.npz", **recording(16, 2))
    source = run_transform(TorchModule(policy=policy), None, folder / "source", Context()).bundle
    return run_transform(ExportOnnx(), source, folder / "float", Context()).bundle


@pytest.fixture(scope="module")
def made(fragile: Bundle, tmp_path_factory: pytest.TempPathFactory):
    """A function that quantizes the fragile policy, each stage once."""
    folder = tmp_path_factory.mktemp("made")
    found: dict[str, Bundle] = {}

    def make(stage) -> Bundle:
        key = stage.key(fragile.hash)
        if key not in found:
            found[key] = run_transform(stage, fragile, folder / key, Context()).bundle
        return found[key]

    return make


@pytest.fixture(scope="module")
def report(fragile: Bundle, made) -> Report:
    return explain(made(StaticInt8(samples=16)), Options(fragile.path, samples=8), Context())


def details(report: Report, words: str) -> list[dict]:
    return next((rows for row in report.rows for title, rows in row.details.items() if words in title), [])


@pytest.mark.parametrize(("taken", "validity"), [(1.5, "suspect"), (0.0, "valid")])
def test_other_work_on_the_machine_is_told(fragile, made, monkeypatch, taken, validity):
    machine = {**fingerprint(), "cores_online": 2, "processors_busy": taken}
    monkeypatch.setattr("vlatool.explain.before_run", lambda: machine)
    options = Options(fragile.path, samples=1, runs=2, suggest=False)
    found = explain(made(StaticInt8(samples=16)), options, Context())
    assert found.validity == validity
    assert ("contended machine" in "".join(each.reason for each in found.findings)) is (validity == "suspect")


def test_the_fragile_layer_is_named_first_and_far_ahead(report):
    layers = details(report, "Layers that cost the accuracy")
    assert layers[0]["layer"].startswith(FRAGILE)
    assert layers[0]["error %"] > 5 * layers[1]["error %"]
    assert f"costs most is '{layers[0]['layer']}'" in report.summary[0]
    elements = details(report, "What the worst layers do to the action")
    assert [(row["element"], row["unit"]) for row in elements] == [("dx", "mm"), ("dy", "mm"), ("gripper", "1")]


def test_the_suggested_plan_repairs_the_bundle(report, fragile, made):
    chosen = [row for row in report.rows if row.role == "chosen"]
    assert len(chosen) == 1
    assert FRAGILE in chosen[0].reason
    now = next(row for row in report.rows if row.name == "static_int8")
    assert chosen[0].value("raw_relative_error") < 0.3 * now.value("raw_relative_error")
    assert report.summary[1].startswith("Do this: vlatool quantize static-int8")
    again = explain(made(StaticInt8(samples=16, exclude=(f"{FRAGILE}.*",))), Options(fragile.path, None, 8), Context())
    assert all(not row["layer"].startswith(FRAGILE) for row in details(again, "Layers that cost"))


def test_the_suggested_command_runs_as_it_is_printed(report, tmp_path):
    import shlex

    text = next(row.reason for row in report.rows if row.role == "chosen")
    words = shlex.split(text.replace(" -o BUNDLE", f" -o {tmp_path / 'new'}"))
    result = CliRunner().invoke(app, words[1:])
    assert result.exit_code == 0, result.output
    assert Bundle.open(tmp_path / "new").manifest.made_by["options"]["exclude"]


def test_every_format_shows_the_report(report):
    lines = TerminalRenderer(80).render(report).splitlines()
    assert max(map(len, lines)) <= 80
    assert any("Time by operator" in line for line in lines)
    for format in ("html", "markdown"):
        assert "Layers that cost the accuracy" in render(report, format)
    again = Report.from_json(report.to_json())
    assert again.summary == report.summary


def test_time_is_that_of_the_engine_and_adds_up(report, made):
    assert sum(row["share %"] for row in details(report, "Time by what")) == pytest.approx(100, abs=0.3)
    assert any(row["operator"] == "MatMulIntegerToFloat" for row in details(report, "Time by operator"))
    bundle = made(StaticInt8(samples=16))
    found = profile(bundle, [dict(zip(("state", "time"), (np.zeros(24, "f"), np.zeros(1, "f")), strict=True))], 5)
    assert list(shares(found)) == [group for group in GROUPS if group in shares(found)]
    assert all(each.calls >= 1 and each.ms >= 0 for each in found)
    assert [each.ms for each in found] == sorted((each.ms for each in found), reverse=True)


def test_standard_qdq_on_onnx_runtime_dequantizes_weights_at_every_inference(fragile, made):
    report = explain(made(StaticInt8(samples=16, layout="qdq")), Options(fragile.path, samples=4), Context())
    whys = {row["what happened"] for row in details(report, "fell back")}
    assert any("dequantized to float at every inference" in why for why in whys)
    assert any("computed in float" in why for why in whys)
    assert any(row.name == "layout ort" for row in report.rows)
    assert any(text.startswith("Fell back: ") for text in report.summary)


def test_signed_activations_on_x86_are_called_slow(made, monkeypatch):
    bundle = made(StaticInt8(samples=16, activations="int8"))
    observation = {name: values[0] for name, values in recording(1, 0).items()}
    graph = QuantizedGraph("main", bundle.path / "graphs/main.onnx")
    for machine, wanted in (("x86_64", True), ("aarch64", False)):
        monkeypatch.setattr("platform.machine", lambda machine=machine: machine)
        found = fallbacks(graph, profile(bundle, [observation], 3), "ort_cpu")
        assert any("int8 x int8" in each.why for each in found) == wanted


def test_openvino_is_profiled_by_its_own_counters(fragile, made):
    pytest.importorskip("openvino")
    bundle = made(StaticInt8(samples=16, layout="openvino"))
    report = explain(bundle, Options(fragile.path, samples=4, suggest=False), Context())
    assert any(row["operator"].startswith("FullyConnected") for row in details(report, "Time by operator"))
    assert details(report, "Layers that cost")[0]["layer"].startswith(FRAGILE)
    assert len(report.rows) == 2


def test_where_openvino_is_confined_float32_is_compared_in_it_too(fragile, made, monkeypatch):
    """A ratio to ONNX Runtime, which cannot be confined, would be one of two instruction sets."""
    pytest.importorskip("openvino")
    bundles = made(StaticInt8(samples=16, layout="openvino")), made(StaticInt8(samples=16))
    opened: list[str] = []
    start = Policy.__init__

    def noted(self: Policy, bundle: Bundle, program: Any, engine: str) -> None:
        opened.extend([engine] if bundle.hash == fragile.hash else [])
        start(self, bundle, program, engine)

    monkeypatch.setattr(Policy, "__init__", noted)
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    for told, wanted in (("", [{"ort_cpu"}, {"ort_cpu"}]), ("AVX2", [{"openvino"}, {"ort_cpu"}])):
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", told)
        for bundle, engines in zip(bundles, wanted, strict=True):
            opened.clear()
            found = _Findings(bundle, fragile, origin(bundle), observations_of(bundle, fragile, None, 2))
            _times(found, Options(runs=2), Context())
            measure(bundle, fragile, [], found.observations.values, Path(), 1, Context())
            assert (set(opened), len(opened)) == (engines, 2)


def test_attention_that_openvino_fuses_with_a_quantization_counts_as_computation(float_bundle, tmp_path):
    pytest.importorskip("openvino")
    bundle = StaticInt8(samples=8, layout="openvino").run(float_bundle, tmp_path, Context()).bundle
    names = {node.name for node in onnx.load(bundle.path / "graphs/main.onnx").graph.node}
    found = [each for each in profile(bundle, recorded_observations(float_bundle, 1), 3) if "Subgraph" in each.kind]
    assert any(each.product and each.precision == "float32" for each in found), "the products inside attention"
    for each in found:
        assert ("quantize" in each.name.lower()) == (each.precision == "quantize-dequantize")
        assert each.precision == "quantize-dequantize" or each.name in names


def test_dynamic_int8_is_explained_too(fragile, made):
    report = explain(made(DynamicInt8()), Options(fragile.path, samples=4), Context())
    assert details(report, "Layers that cost")[0]["layer"].startswith(FRAGILE)
    assert any("quantize dynamic-int8" in row.reason and FRAGILE in row.reason for row in report.rows)


def test_without_the_float_bundle_the_command_is_given(made):
    report = explain(made(StaticInt8(samples=16)), Options(samples=4), Context())
    assert any("--baseline FLOAT_BUNDLE" in text for text in report.warnings)
    assert not details(report, "Layers that cost")
    assert details(report, "Time by operator")


def test_the_float_bundle_is_found_in_the_cache(fragile, made, monkeypatch, tmp_path):
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path))
    shutil.copytree(fragile.path, tmp_path / "stages" / "export.onnx-0")
    sentences = explanation(made(StaticInt8(samples=16)), None, Context(), samples=4, runs=3)
    assert f"'{FRAGILE}" in sentences[0]
    assert any("Amdahl" in text for text in sentences)


def test_the_bundle_of_another_policy_is_refused(fragile, made, float_bundle, source_bundle):
    with pytest.raises(BundleError, match=r"is not what .* was made from"):
        explain(made(StaticInt8(samples=16)), Options(float_bundle.path), Context())
    with pytest.raises(BundleError, match="no graph to explain"):
        explain(source_bundle, Options(), Context())
    int8 = made(StaticInt8(samples=16))
    with pytest.raises(BundleError, match=r"it is quantized itself \(int8\)"):
        explain(int8, Options(int8.path), Context())


def uncut(fragile: Bundle, folder: Path) -> Bundle:
    """The bundle that bfloat16 made before it knew of phases."""
    shutil.copytree(fragile.path, folder)
    graphs = {name: replace(graph, compute="bfloat16") for name, graph in fragile.manifest.graphs.items()}
    made_by = {"stage": "quantize.bfloat16", "options": {}}
    changed = replace(fragile.manifest, engine="openvino", graphs=graphs, parent=fragile.hash, made_by=made_by)
    return seal(folder, changed)


@pytest.mark.needs("bfloat16", reason="a phase is measured in what it is computed in")
def test_a_phase_in_bfloat16_is_found_and_measured(fragile, made, tmp_path):
    pytest.importorskip("openvino")
    bundle = uncut(fragile, tmp_path / "uncut")
    report = explain(bundle, Options(fragile.path, samples=8, suggest=False), Context())
    assert "which ruins such phases" in report.summary[0]
    assert "with the phases in float32. Make it again: vlatool quantize bfloat16" in report.summary[0]
    good = explain(made(Bfloat16()), Options(fragile.path, samples=8, suggest=False), Context())
    text = next(text for text in good.summary if "stay in float32, in the graph main_phases" in text)
    assert "it would be" in text
    errors = [
        next(row for row in each.rows if row.name == "bfloat16").value("raw_relative_error") for each in (report, good)
    ]
    assert errors[1] < 0.3 * errors[0]


def test_the_history_names_stage_and_options(fragile, made):
    found = origin(made(StaticInt8(samples=16, method="percentile", per_channel=False)))
    assert found.inputs == (fragile.hash,)
    assert command(found.stage, "F") == (
        "vlatool quantize static-int8 F -o BUNDLE --samples 16 --method percentile --no-per-channel"
    )
    assert origin(fragile).stage is None


def test_round_trips_are_found_by_structure(tmp_path):
    import onnx
    from onnx import TensorProto, helper

    scale = helper.make_tensor("s", TensorProto.FLOAT, [], [0.1])
    zero = helper.make_tensor("z", TensorProto.UINT8, [], [3])
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"], "first"),
        helper.make_node("DequantizeLinear", ["q", "s", "z"], ["d"], "back"),
        helper.make_node("QuantizeLinear", ["d", "s", "z"], ["q2"], "again"),
        helper.make_node("DequantizeLinear", ["q2", "s", "z"], ["d2"], "last"),
        helper.make_node("Relu", ["d2"], ["r"], "relu"),
        helper.make_node("QuantizeLinear", ["r", "s", "z"], ["y"], "end"),
    ]
    values = [
        helper.make_tensor_value_info(*each, [1]) for each in (("x", TensorProto.FLOAT), ("y", TensorProto.UINT8))
    ]
    onnx.save(
        helper.make_model(helper.make_graph(nodes, "g", values[:1], values[1:], [scale, zero])), tmp_path / "g.onnx"
    )
    graph = QuantizedGraph("g", tmp_path / "g.onnx")
    assert [(each.start, each.between, each.end) for each in with_times(graph.round_trips(), [])] == [
        ("back", (), "again"),
        ("last", ("Relu",), "end"),
    ]
    assert graph.pairs() == (3, 2)
    assert graph.asymmetric() == ["first", "again", "end"]


def test_the_command_writes_report_and_json(fragile, made, tmp_path):
    bundle = made(StaticInt8(samples=16))
    arguments = ["explain", str(bundle.path), "--baseline", str(fragile.path), "--samples", "4", "--no-suggest"]
    result = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "report"), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["kind"] == "explain"
    assert (tmp_path / "report/report.html").is_file()


def test_recorded_observations_may_have_other_names(float_bundle, policy_dir, tmp_path):
    arrays = dict(np.load(policy_dir / "evaluation.npz"))
    arrays["joints"] = arrays.pop("proprio")
    np.savez(tmp_path / "other.npz", **arrays)
    named = named_recording(tmp_path / "other.npz", ["proprio=joints"])
    found = observations_of(float_bundle, None, named, 2)
    assert (len(found.values), found.words) == (2, "other.npz")
    with pytest.raises(DataError, match="proprio"):
        observations_of(float_bundle, None, named_recording(tmp_path / "other.npz", []), 2)
