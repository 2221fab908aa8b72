import numpy as np
import onnx
import onnxruntime as ort
import pytest

from vlatool.data import recorded_observations
from vlatool.errors import DataError, GraphError
from vlatool.export.onnx import ExportOnnx
from vlatool.graph.files import load as load_graph
from vlatool.graph.layers import find_layers
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sensitivity._switches import add_switches
from vlatool.sensitivity.layers import Switchboard, ranges_of, sensitivities
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

STYLES = [
    {},
    {"activations": "int8"},
    {"per_channel": False, "reduce_range": True},
    {"attention": True, "method": "percentile"},
]


def outputs(bundle, observations, *, fused=True):
    """The raw actions; unfused, as the standard says: fused kernels round a few values to the other neighbour."""
    policy = load(bundle.path, threads=1, engine="ort_cpu")
    if not fused:
        options = ort.SessionOptions()
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        path = str(bundle.path / "graphs/main.onnx")
        session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        names = [node.name for node in session.get_inputs()]
        encoded = [policy.encode(observation) for observation in observations]
        return [session.run(["action"], {name: values[name] for name in names})[0] for values in encoded]
    return [policy.infer(observation).outputs["action"] for observation in observations]


@pytest.fixture(scope="module")
def observations(float_bundle):
    return recorded_observations(float_bundle, 6, float_bundle.path / "data/evaluation.npz")


@pytest.mark.parametrize("options", STYLES, ids=str)
def test_all_switches_on_is_the_int8_bundle_and_all_off_is_float32(quantized, float_bundle, observations, options):
    stage = StaticInt8(layout="qdq", samples=8, **options)
    wanted = outputs(quantized(stage), observations, fused=False)
    plain = outputs(float_bundle, observations)
    with Switchboard(float_bundle, stage, ranges_of(float_bundle, stage, Context())) as board:
        for observation, int8, float32 in zip(observations, wanted, plain, strict=True):
            off = board.reference(observation).outputs["action"].copy()
            on = board.run(board.shares, observation).outputs["action"]
            assert relative_error(off, float32) < 1e-6
            assert relative_error(int8, float32) > 1e-3
            assert relative_error(on, int8) < 1e-5


def test_one_layer_alone_is_the_bundle_with_that_layer_alone(quantized, float_bundle, observations):
    stage = StaticInt8(layout="qdq", samples=8)
    found = sensitivities(float_bundle, stage, None, observations, Context())
    plain = outputs(float_bundle, observations)
    for each in (found[0], found[-1]):
        only = outputs(quantized(stage.model_copy(update={"include": (each.name,)})), observations)
        wanted = np.mean([relative_error(got, base) for got, base in zip(only, plain, strict=True)])
        assert each.error == pytest.approx(wanted, rel=0.02)


def test_the_rows_are_complete_and_the_worst_is_first(float_bundle, observations):
    told = []
    context = Context(progress=lambda text, share: told.append(share))
    found = sensitivities(float_bundle, StaticInt8(samples=8), None, observations, context)
    assert [each.error for each in found] == sorted((each.error for each in found), reverse=True)
    assert len(found) == len({each.name for each in found}) == 8
    assert {each.graph for each in found} == {"main"}
    assert all(0 < each.macs_share < 1 and each.jump > 0 and each.flips == 0 for each in found)
    assert all(set(each.elements) == {"dx", "dy"} and min(each.elements.values()) > 0 for each in found)
    shares = [share for share in told if share is not None]
    assert shares == sorted(shares)
    assert shares[-1] < 1


def test_a_group_is_all_its_layers_together(quantized, float_bundle, observations):
    stage = StaticInt8(layout="qdq", samples=8)
    ranges = ranges_of(float_bundle, stage, Context())
    with Switchboard(float_bundle, stage, ranges) as board:
        everything = list(board.shares)
        whole, one = board.errors([everything, everything[:1]], observations, Context())
    pairs = zip(outputs(quantized(stage), observations), outputs(float_bundle, observations), strict=True)
    assert whole.error == pytest.approx(np.mean([relative_error(*pair) for pair in pairs]), rel=0.02)
    assert whole.error > one.error
    assert one.name == everything[0][1]


def test_without_ranges_a_graph_is_quantized_as_dynamic_int8_does(quantized, float_bundle, observations):
    from vlatool.quantize.dynamic_int8 import DynamicInt8

    stage = StaticInt8(ops=("MatMul", "Gemm"))
    with Switchboard(float_bundle, stage, {}) as board:
        for observation, int8 in zip(observations, outputs(quantized(DynamicInt8()), observations), strict=True):
            float32 = board.reference(observation).outputs["action"].copy()
            on = board.run(board.shares, observation).outputs["action"]
            assert relative_error(on, int8) < 0.1 * relative_error(int8, float32)


def test_a_range_that_is_missing_is_named(float_bundle):
    stage = StaticInt8()
    path = float_bundle.path / "graphs/main.onnx"
    layers = find_layers(load_graph(path), stage.ops)
    with pytest.raises(GraphError, match="has no range"):
        add_switches(path, layers, {}, stage.style)


def test_the_graph_with_switches_is_valid_onnx(float_bundle):
    path = float_bundle.path / "graphs/main.onnx"
    model, flags = add_switches(path, find_layers(load_graph(path), ("MatMul", "Conv")), None, StaticInt8().style)
    onnx.checker.check_model(model, full_check=True)
    assert sum(node.op_type == "If" for node in model.graph.node) == len(flags) + 1  # the convolution's output


def test_without_an_observation_nothing_is_said(float_bundle):
    with pytest.raises(DataError, match="No observations"):
        sensitivities(float_bundle, StaticInt8(samples=8), None, [], Context())


FLOW_YAML = """\
name: flow
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 3]}]
  outputs: [{name: action, shape: [1, 4, 2]}]
  control_hz: 10
  chunk: 4
program:
  - graph: encode
    feeds: {state: state}
    gives: {memory: memory}
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
        self.inner = nn.Linear(8 + 2 + 1, 16)
        self.outer = nn.Linear(16, 2)

    def forward(self, memory, noisy, time):
        context = torch.cat([memory, time[None]], 1)[:, None].expand(1, 4, 9)
        return noisy - (1 - time) * self.outer(torch.tanh(self.inner(torch.cat([context, noisy], 2))))

def make():
    torch.manual_seed(0)
    return {"encode": Encode(), "denoise": Denoise()}
"""


@pytest.fixture(scope="module")
def flow(tmp_path_factory):
    """Two graphs, the second of which runs three times on noise."""
    folder = tmp_path_factory.mktemp("flow")
    policy = folder / "policy"
    policy.mkdir()
    (policy / "policy.yaml").write_text(FLOW_YAML)
    (policy / "policy.py").write_text(FLOW_PY)
    np.savez(policy / "calibration.npz", state=np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32))
    source = run_transform(TorchModule(policy=policy), None, folder / "source", Context()).bundle
    return run_transform(ExportOnnx(), source, folder / "float", Context()).bundle


def test_layers_of_a_loop_are_int8_in_every_turn_and_the_noise_stays_the_same(flow, quantized):
    stage = StaticInt8(layout="qdq", samples=8)
    observations = recorded_observations(flow, 4)
    found = {(each.graph, each.name): each for each in sensitivities(flow, stage, None, observations, Context())}
    assert {graph for graph, _ in found} == {"encode", "denoise"}
    assert sum(each.macs_share for each in found.values()) == pytest.approx(2, abs=1e-6)
    for (graph, name), each in found.items():
        only = quantized(stage.model_copy(update={"graphs": (graph,), "include": (name,)}), flow)
        errors = []
        for observation in observations:
            policies = [load(bundle.path, threads=1, seed=0) for bundle in (only, flow)]
            errors.append(relative_error(*(policy.infer(observation).outputs["action"] for policy in policies)))
        assert each.error == pytest.approx(np.mean(errors), rel=0.05)


def test_a_limit_in_seconds_takes_observations_away_not_layers(flow):
    stage = StaticInt8(samples=8)
    found = sensitivities(flow, stage, None, recorded_observations(flow, 4), Context(), seconds=1e-9)
    assert {each.samples for each in found} == {1}
    assert len(found) == 3
