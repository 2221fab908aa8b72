"""What engines ran, against what a bundle promises: on the processor's engines for real, faults of others injected."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

import vlatool
from vlatool.bundle.bundle import Bundle, replace_manifest
from vlatool.bundle.manifest import Graph
from vlatool.errors import GraphError, UsageError
from vlatool.runtime.engine import NodeRun, engine_class
from vlatool.runtime.engine_record import EngineRecord, graph_record
from vlatool.runtime.policy import Policy

INT8_PRODUCT = """<ir_version: 10, opset_import: ["" : 20]>
g (float[1,64] x) => (float[1,64] y) <float s = {0.02}, ZERO, int8 z = {0}, float[1] unused = {0}> {
  q = QuantizeLinear(x, s, zx)  d = DequantizeLinear(q, s, zx)
  e = DequantizeLinear(w, s, z)  m = MatMul(d, e)
  p = QuantizeLinear(m, s, zx)  y = DequantizeLinear(p, s, zx) }"""
HALF_PRODUCT = """<ir_version: 10, opset_import: ["" : 20]>
g (float16[1,64] x) => (float16[1,64] y) { y = MatMul(x, w) }"""
CPU, CARD = "CPUExecutionProvider", "CUDAExecutionProvider"


def graph(folder: Path, text: str, dtype: Any) -> Path:
    model = onnx.parser.parse_model(text.replace("ZERO", "uint8 zx = {128}"))
    weights = np.random.default_rng(0).integers(-60, 60, (64, 64)).astype(dtype)
    model.graph.initializer.append(onnx.numpy_helper.from_array(weights, "w"))
    onnx.save(model, folder / "graph.onnx")
    return folder / "graph.onnx"


class Ran:
    """A session that says that it ran these nodes."""

    def __init__(self, *runs: NodeRun) -> None:
        self._runs = runs

    def node_runs(self) -> list[NodeRun]:
        return list(self._runs)


def record_of(session: Any, *targets: str, compute: str = "", **promised: float) -> Any:
    precision = {name.replace("_", " "): share for name, share in promised.items()}
    return graph_record("main", Graph("graph.onnx", precision, compute=compute), session, targets)


@pytest.mark.parametrize(("engine", "provider"), [("ort_cpu", CPU), ("openvino", "CPU")])
def test_an_int8_product_is_shown_to_run_in_int8_or_that_it_does_not(
    tmp_path: Path, engine: str, provider: str
) -> None:
    session = engine_class(engine)(graph(tmp_path, INT8_PRODUCT, np.int8), 1, traced=True)
    session.run({"x": np.ones((1, 64), np.float32)})
    (share,) = record_of(session, provider, int8=1.0).shares
    assert share.provider == provider
    found = record_of(session, provider, int8=1.0)
    assert found.promised == {"int8": 1.0}
    assert bool(found.problems) == (share.macs != {"int8": 1.0})
    assert record_of(session, provider, **share.macs).problems == ()


def test_float16_that_the_processor_computes_in_float32_is_a_problem(tmp_path: Path) -> None:
    """ONNX Runtime has no kernels of float16 products on x86: it casts them to float32 without a word."""
    session = engine_class("ort_cpu")(graph(tmp_path, HALF_PRODUCT, np.float16), 1, traced=True)
    session.run({"x": np.ones((1, 64), np.float16)})
    found = record_of(session, CPU, float16=1.0)
    (share,) = found.shares
    assert sum(share.macs.values()) == 1
    if "float16" not in share.macs:
        assert found.problems == (
            "graph 'main': float16 is promised for 100.0% of the multiply-accumulates; it ran float32 100.0% of them.",
        )


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_a_float_policy_runs_as_promised(float_bundle: Bundle, engine: str) -> None:
    policy = vlatool.load(float_bundle.path, engine=engine, threads=1, engine_proof="require")
    record = policy.engine_record()
    assert [(graph.graph, graph.promised, graph.problems) for graph in record.graphs] == [
        ("main", {"float32": 1.0}, ())
    ]
    assert record.graphs[0].shares[0].macs == {"float32": 1.0}
    assert record.graphs[0].shares[0].nodes > 5
    assert record.library.startswith(engine_class(engine).title)
    assert json.loads(json.dumps(record.to_dict()))["graphs"][0]["graph"] == "main"


def test_a_bundle_that_promises_another_precision_is_told_or_refused(
    float_bundle: Bundle, copied: Callable[[Bundle], Bundle]
) -> None:
    copy = copied(float_bundle)
    graphs = {name: replace(graph, precision={"int8": 1.0}) for name, graph in copy.manifest.graphs.items()}
    path = replace_manifest(copy, replace(copy.manifest, graphs=graphs)).path
    with pytest.warns(RuntimeWarning, match=r"int8 is promised for 100.0% .*it ran float32 100.0% of them"):
        vlatool.load(path, threads=1, engine_proof="warn")
    with pytest.raises(GraphError, match="did not run as asked: graph 'main': int8 is promised") as caught:
        vlatool.load(path, threads=1, engine_proof="require")
    assert "the engine that it was made for" in caught.value.fix
    assert vlatool.load(path, threads=1, engine_proof="record").engine_record().problems


def test_int8_layers_are_counted_as_they_run(int8_bundle: Bundle) -> None:
    record = vlatool.load(int8_bundle.path, threads=1, engine_proof="record").engine_record()
    (graph,) = record.graphs
    difference = graph.promised["int8"] - graph.shares[0].macs.get("int8", 0.0)
    assert bool(record.problems) == (difference > 0.02)


def test_a_proof_takes_an_inference(float_bundle: Bundle) -> None:
    vlatool.load(float_bundle.path, threads=1, warmup=0, engine_proof="require")
    silent = Policy.open(float_bundle, threads=1)
    assert silent.engine_record().problems == ("graph 'main': the engine tells of no node that it ran.",)
    with pytest.raises(UsageError, match="engine_proof is 'yes'; allowed: '', 'record', 'warn', 'require'"):
        vlatool.load(float_bundle.path, engine_proof="yes")


PRODUCT = NodeRun("proj", "MatMul", CARD, "float16", 900)


def test_a_node_that_fell_back_to_the_processor_is_named_with_its_share() -> None:
    fell = NodeRun("det", "Det", CPU, "float32", 100)
    found = record_of(Ran(PRODUCT, fell), CARD, float16=0.9, float32=0.1)
    assert found.problems == (
        f"graph 'main': 1 of 2 nodes (10.0% of the multiply-accumulates) ran on {CPU}, not on {CARD}: Det (det).",
    )
    assert [(share.provider, share.nodes) for share in found.shares] == [(CARD, 1), (CPU, 1)]
    assert record_of(Ran(PRODUCT, fell), CARD, CPU, float16=0.9, float32=0.1).problems == ()


@pytest.mark.parametrize(
    ("session", "promised", "says"),
    [
        (Ran(PRODUCT), {"float8e4m3fn": 1.0}, "float8e4m3fn is promised for 100.0% .*; it ran float16 100.0% of them."),
        (Ran(PRODUCT), {"float32": 1.0}, "float32 is promised for 100.0%"),
        (Ran(PRODUCT, replace(PRODUCT, precision="float32", macs=100)), {"float16": 1.0}, "float16 90.0%, float32 10"),
        (Ran(replace(PRODUCT, provider="GPU.1")), {"float16": 1.0}, r"1 of 1 nodes .*ran on GPU.1, not on CUDA"),
        (Ran(NodeRun("", "TRTKernel_1", CARD, "", None)), {"int8": 1.0}, "does not tell .*not counted: TRTKernel_1"),
        (Ran(replace(PRODUCT, provider="")), {"float16": 1.0}, "ran on something unnamed"),
        (Ran(), {"float16": 1.0}, "tells of no node"),
        (object(), {"float32": 1.0}, "tells of no node"),
    ],
    ids=["float8", "narrower", "partly", "device", "compiled", "unnamed", "nothing", "mute"],
)  # fmt: skip
def test_each_difference_from_what_was_asked_for_is_said(session: Any, promised: dict[str, float], says: str) -> None:
    (problem,) = record_of(session, CARD, **promised).problems
    assert re.search(says, problem)
    record = EngineRecord("e", "Library 1", "", "", "", (record_of(session, CARD, **promised),))
    with pytest.raises(GraphError, match="Library 1 did not run as asked: graph 'main'"):
        record.check()
    assert any(problem in line for line in record.lines())


def test_weights_alone_promise_no_precision_of_the_computation() -> None:
    assert record_of(Ran(replace(PRODUCT, precision="float32")), CARD, int4_weights=0.9, float32=0.1).problems == ()


def test_what_is_computed_in_bfloat16_is_promised_so() -> None:
    assert record_of(Ran(replace(PRODUCT, precision="bfloat16")), CARD, compute="bfloat16", float32=1.0).problems == ()
    assert record_of(Ran(replace(PRODUCT, precision="float32")), CARD, compute="bfloat16", float32=1.0).problems
