"""What never ends, or declares more than there is memory for, is a named error that says how to raise the limit."""

import subprocess
import sys
from pathlib import Path

import pytest
from _written import ENDLESS, X, Y, written

from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.errors import BundleError, GraphError
from vlatool.runtime import Policy, load
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.probe import probe

RAISED = ("repeat", "runs", "elements", "state_elements")
GOLDEN = {"in.x": [[1, 2]], "out.y": [[[1, 2]]]}
NEG = "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }"
BILLION = """g (float[1,2] x) => (float[N,2] y) <int64[2] k = {800000000, 1}, int64[1] two = {2}> {
    c = Cast<to = 7>(x)  r = Reshape(c, two)  s = Mul(r, k)  t = Expand(x, s)  y = Neg(t) }"""
"""6.4 GB, known only when it runs."""
INNER = """g (float[1,2] x) => (float[1,2] y) <int64[2] s = {800000000, 1}, int64[1] a = {0}> {
    t = Expand(x, s)  u = Neg(t)  v = ReduceMax<keepdims = 1>(u, a)  y = Identity(v) }"""

ONE_NODE = """g (float[1,2] x) => (float[1,2] y) <int64[4] s = {1, 1, 4096, 4096}, float z = {0}> {
    big = ConstantOfShape(s)  m = ReduceMax<keepdims = 0>(x)  in = Add(big, m)
    p = MaxPool<kernel_shape = [2047, 2047], strides = [1, 1]>(in)
    q = ReduceMax<keepdims = 0>(p)  w = Mul(q, z)  y = Add(x, w) }"""
"""One node that takes hours."""


def test_a_graph_without_end_is_stopped(tmp_path: Path):
    bundle = written(tmp_path, ENDLESS, golden=GOLDEN)
    with pytest.raises(GraphError, match=r"takes longer than 0.3 s, so it was stopped\.") as caught:
        load(bundle.path, threads=1, first_run_s=0.3)
    assert "first_run_s" in caught.value.fix


def test_a_session_that_was_stopped_runs_again(tmp_path: Path):
    trips = TensorSpec("trips", (1,), "int64")
    text = ENDLESS.replace("(float[1,2] x) =>", "(float[1,2] x, int64[1] trips) =>").replace(
        "int64 trips = {4611686018427387904}, ", ""
    )
    policy = Policy.open(written(tmp_path, text, (X, trips)), threads=1)
    policy.limit_s = 0.2
    with pytest.raises(GraphError, match=r"takes longer than 0\.2 s"):
        policy.infer({"x": [1, 2], "trips": [2**62]})
    assert policy.infer({"x": [1, 2], "trips": [3]}).chunk.tolist() == [[-1, -2]]


@pytest.fixture
def allowed(monkeypatch):
    """What a manifest may declare is raised, to reach the limits behind it."""
    monkeypatch.setenv("VLATOOL_LIMITS", ",".join(f"{name}={10**13}" for name in RAISED))


def test_a_program_of_many_short_runs_is_stopped_too(tmp_path: Path, allowed):
    program = (ProgramStep("main", {"x": "x"}, {"y": "y"}, repeat=10**9, carry={"y": "x"}),)
    bundle = written(tmp_path, NEG, program=program, golden=GOLDEN)
    with pytest.raises(GraphError, match=r"longer than 0\.3 s"):
        load(bundle.path, threads=1, first_run_s=0.3)


def test_an_endless_graph_of_openvino_is_told_though_it_cannot_be_ended(tmp_path: Path):
    """In a process of its own: OpenVINO computes on until that ends."""
    bundle = written(tmp_path, ENDLESS, golden=GOLDEN)
    code = (
        "import vlatool\n"
        "try:\n"
        f"    vlatool.load({str(bundle.path)!r}, engine='openvino', threads=1, first_run_s=0.3)\n"
        "except vlatool.errors.GraphError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert "OpenVINO goes on with it until this process ends" in done.stdout, done.stderr
    assert done.returncode == 0


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_a_deadline_changes_no_answer(tmp_path: Path, engine):
    policy = Policy.open(written(tmp_path, NEG), engine=engine, threads=1)
    plain = policy.infer({"x": [1, 2]}).chunk
    policy.limit_s = 60.0
    assert policy.infer({"x": [1, 2]}).chunk.tolist() == plain.tolist()
    assert all(session.deadline is None for session in policy.program.sessions.values())


def test_a_deadline_that_has_passed_stops_before_the_run(tmp_path: Path):
    written(tmp_path, NEG)
    session = OrtCpuSession(tmp_path / "graphs/main.onnx", 1)
    session.deadline = 0.0
    with pytest.raises(TimeoutError):
        session.run({})


def large(name: str) -> TensorSpec:
    return TensorSpec(name, (1, 800_000_000, 2))


def test_an_output_that_is_declared_too_large_is_refused_before_it_runs(tmp_path: Path, allowed):
    text = "g (float[1,2] x) => (float[1,800000000,2] y) <int64[3] s = {1, 800000000, 2}> { y = Expand(x, s) }"
    bundle = written(tmp_path, text, outputs=(large("y"),), chunk=800_000_000)
    with pytest.raises(GraphError, match=r"6,400 MB, most of it 'y' .*; allowed: 2,000 MB") as caught:
        load(bundle.path)
    assert "memory_mb" in caught.value.fix


@pytest.mark.parametrize("word", ["keep", "noise"])
def test_a_value_that_the_program_makes_too_large_is_refused_before_it_is_made(tmp_path: Path, word, allowed):
    step = ProgramStep("main", {"x": "x"}, {"y": "y"}, **{word: {"z": {"shape": [1, 10**12]}}})
    with pytest.raises(GraphError, match="4,000,000 MB, most of it 'z'"):
        load(written(tmp_path, NEG, program=(step,)).path)


def test_an_inner_declaration_is_held_against_the_limit_as_well(tmp_path: Path):
    with pytest.raises(GraphError, match="allowed: 1 MB"):
        load(written(tmp_path, "g (float[1,N] x) => (float[1,N] y) { y = Neg(x) }",
                     (TensorSpec("x", (1, 200_000)),), (TensorSpec("y", (1, 200_000)),)).path, memory_mb=1)  # fmt: skip


def test_the_probe_says_what_a_good_bundle_needs(tmp_path: Path):
    found = probe(written(tmp_path, NEG, golden={**GOLDEN, "out.y": [[[-1, -2]]]}).path)
    assert found["golden_error"] == 0
    assert 10 < found["peak_rss_mb"] < found["memory_mb"]


@pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])
def test_the_probe_stops_what_never_ends(tmp_path: Path, engine):
    with pytest.raises(GraphError, match=r"longer than 0\.5 s"):
        load(written(tmp_path, ENDLESS, golden=GOLDEN).path, engine=engine, threads=1, first_run_s=0.5, probe=True)


def test_the_probe_kills_one_node_that_takes_hours(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("vlatool.runtime.probe.START_S", 4.0)
    bundle = written(tmp_path, ONE_NODE, golden=GOLDEN)
    with pytest.raises(GraphError, match=r"no first action after 5 s, so the process was ended") as caught:
        load(bundle.path, threads=1, first_run_s=1, probe=True)
    assert "first_run_s" in caught.value.fix


@pytest.mark.parametrize("text", [BILLION, INNER], ids=["output", "inside"])
def test_the_probe_limits_the_memory(tmp_path: Path, text):
    output = TensorSpec("y", ("n", 2)) if text == BILLION else Y
    bundle = written(tmp_path, text, outputs=(output,), golden=GOLDEN)
    with pytest.raises(GraphError, match="more than 1,000 MB of memory") as caught:
        load(bundle.path, threads=1, probe=True, memory_mb=1000)
    assert "memory_mb" in caught.value.fix


def test_what_the_bundle_raises_in_the_probe_is_raised_here(tmp_path: Path):
    bundle = written(tmp_path, NEG)
    (bundle.path / "graphs/main.onnx").unlink()
    with pytest.raises(BundleError, match=r"lacks the file graphs/main\.onnx"):
        probe(bundle.path)


def test_a_process_that_crashes_is_told(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("vlatool.runtime.probe.CHILD", "import os; os.abort()")
    with pytest.raises(GraphError, match="ends its process with SIGABRT"):
        probe(written(tmp_path, NEG).path)


def test_a_process_that_says_nothing_is_told(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("vlatool.runtime.probe.CHILD", "raise SystemExit('no such thing')")
    with pytest.raises(GraphError, match="in a process of its own: no such thing"):
        probe(written(tmp_path, NEG).path)


def test_the_probe_imports_nothing_of_the_current_directory(tmp_path: Path, monkeypatch):
    bundle = written(tmp_path / "bundle", NEG)
    (tmp_path / "random.py").write_text("raise SystemExit('ran')")
    (tmp_path / "json.py").write_text("raise SystemExit('ran')")
    monkeypatch.chdir(tmp_path)
    assert probe(bundle.path)["golden_error"] is None
