import json

import pytest

from vlatool.errors import BundleError, SpecError
from vlatool.manifest import FileRecord, Graph, Manifest, ProgramStep, check_program, program_from, single_graph
from vlatool.spec import PolicySpec, TensorSpec

SPEC = PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0)
GRAPHS = {"main": Graph("graphs/main.onnx", {"float32": 1.0}, 20)}
FILES = {"graphs/main.onnx": FileRecord("00", 3)}
DIFFUSION = [
    {"graph": "encode", "feeds": {"image": "x"}, "gives": {"memory": "memory"}, "keep": {"memory": {"shape": [1, 2]}}},
    {
        "graph": "step",
        "feeds": {"memory": "memory", "noisy": "noisy", "time": "time"},
        "gives": {"less": "y"},
        "repeat": 2,
        "carry": {"y": "noisy"},
        "schedule": {"time": [0.0, 0.5]},
        "noise": {"noisy": {"shape": [1, 2], "distribution": "normal"}},
    },
]
DIFFUSION_GRAPHS = {"encode": Graph("graphs/encode.onnx"), "step": Graph("graphs/step.onnx")}
MANIFESTS = [
    Manifest("source", "1.0.0", SPEC, source={"factory": "a.py:make"}, program=single_graph(SPEC)),
    Manifest("plain", "1.0.0", SPEC, GRAPHS, single_graph(SPEC), FILES, parent="sha256:ab", golden="golden/golden.npz"),
    Manifest(
        "diffusion",
        "0.3.0",
        SPEC,
        DIFFUSION_GRAPHS,
        program_from(DIFFUSION),
        {graph.file: FileRecord("11", 5) for graph in DIFFUSION_GRAPHS.values()},
        accuracy={"success": {"value": 0.9}},
        parts={"head": ["head*"]},
        environment={"make": "e.py:make", "tasks": ["reach"]},
        description="two graphs",
        license="MIT",
    ),
]


def step(**changes):
    return ProgramStep(**{"graph": "main", "feeds": {"a": "x"}, "gives": {"b": "y"}, **changes})


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda manifest: manifest.name)
def test_a_manifest_survives_json(manifest):
    assert Manifest.from_dict(json.loads(json.dumps(manifest.to_dict()))) == manifest


def test_empty_values_are_left_out():
    plain = MANIFESTS[0].to_dict()
    assert not {"accuracy", "license", "parts", "parent"} & set(plain)
    assert plain["program"] == [{"graph": "main", "feeds": {"x": "x"}, "gives": {"y": "y"}}]


def test_a_key_of_a_later_vlatool_within_the_schema_is_passed_over():
    assert Manifest.from_dict({**MANIFESTS[1].to_dict(), "colour": "red"}) == MANIFESTS[1]


def test_a_newer_schema_asks_for_an_upgrade():
    with pytest.raises(BundleError, match="schema 2; this vlatool reads up to 1") as caught:
        Manifest.from_dict({**MANIFESTS[1].to_dict(), "schema": 2})
    assert caught.value.fix == "upgrade vlatool"


@pytest.mark.parametrize("schema", [None, "1", 0, 1.5])
def test_an_impossible_schema_is_refused(schema):
    with pytest.raises(BundleError, match="this vlatool reads 1 to 1"):
        Manifest.from_dict({**MANIFESTS[1].to_dict(), "schema": schema})


@pytest.mark.parametrize("key", ["name", "version", "spec"])
def test_a_missing_key_is_named(key):
    data = MANIFESTS[1].to_dict()
    del data[key]
    with pytest.raises(BundleError, match=f"no '{key}'"):
        Manifest.from_dict(data)


@pytest.mark.parametrize("data", [None, [], "manifest", 1])
def test_a_manifest_must_be_a_mapping(data):
    with pytest.raises(BundleError, match="must be a mapping"):
        Manifest.from_dict(data)


@pytest.mark.parametrize(
    "change",
    [
        {"graphs": []},
        {"graphs": {"main": "graphs/main.onnx"}},
        {"graphs": {"main": {"path": "graphs/main.onnx"}}},
        {"graphs": {"main": {"file": 5}}},
        {"files": {"graphs/main.onnx": {"sha256": "00"}}},
        {"files": {"graphs/main.onnx": 3}},
        {"files": None},
        {"program": [{"graph": "main", "feeds": {"x": "x"}, "gives": {"y": "y"}, "schedule": 3}]},
        {"program": [{"graph": "main", "feeds": ["x"], "gives": ["y"]}]},
    ],
    ids=str,
)
def test_a_malformed_manifest_is_the_bundles_fault_and_no_traceback(change):
    with pytest.raises((BundleError, SpecError)):
        Manifest.from_dict({**MANIFESTS[1].to_dict(), **change})


@pytest.mark.parametrize("path", ["../main.onnx", "/etc/passwd", "graphs/../../main.onnx", ""])
def test_a_path_that_leaves_the_bundle_is_refused(path):
    with pytest.raises(BundleError, match="not inside the bundle"):
        Manifest("evil", "1", SPEC, files={path: FileRecord("00", 3)})
    with pytest.raises(BundleError, match="not inside the bundle"):
        Manifest("evil", "1", SPEC, {"main": Graph(path)}, files={})


def test_a_graph_needs_a_hash():
    with pytest.raises(BundleError, match=r"graphs/main.onnx, but records no hash"):
        Manifest("plain", "1", SPEC, GRAPHS)


def test_a_single_graph_takes_and_gives_what_the_spec_names():
    assert single_graph(SPEC) == (ProgramStep("main", {"x": "x"}, {"y": "y"}),)


def test_a_program_that_adds_up_is_accepted():
    check_program(program_from(DIFFUSION), DIFFUSION_GRAPHS, SPEC)


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([step(graph="mian")], "Step 0 runs the graph 'mian'; did you mean 'main'"),
        ([step(feeds={"a": "z"})], r"Step 0 \(main\) needs the value 'z' before it exists"),
        ([step(feeds={"a": "y"})], r"Step 0 \(main\) needs the value 'y' before it exists"),
        ([step(gives={"b": "h"}), step(feeds={"a": "hh"})], "needs the value 'hh' .*did you mean 'h'"),
        ([step(carry={"x": "x"})], "Step 0 carries 'x', which 'main' does not give"),
        ([step(gives={"b": "yy"})], "No step of the program gives the output 'y'; did you mean 'yy'"),
    ],
)
def test_a_program_that_does_not_add_up_names_step_and_value(steps, message):
    with pytest.raises(SpecError, match=message):
        check_program(steps, GRAPHS, SPEC)


def test_a_value_may_come_from_schedule_noise_or_keep():
    for source in ({"schedule": {"s": [1]}}, {"noise": {"s": {"shape": [1]}}}, {"keep": {"s": {"shape": [1]}}}):
        check_program([step(feeds={"a": "s"}, **source)], GRAPHS, SPEC)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"repeat": 0}, "repeats 'main' 0 times"),
        ({"repeat": 1.5}, "repeats 'main' 1.5 times"),
        ({"repeat": 3, "schedule": {"t": [1, 2]}}, "schedule of 't' has 2 numbers, but 'main' runs 3 times"),
        ({"noise": {"n": {}}}, "noise 'n' needs a shape"),
        ({"noise": {"n": {"shape": [1], "distribution": "cauchy"}}}, "distribution of normal, uniform, zeros"),
    ],
)
def test_an_impossible_step_is_refused(changes, message):
    with pytest.raises(SpecError, match=message):
        step(**changes)


def test_a_kept_value_needs_a_shape():
    with pytest.raises(SpecError, match="'memory'"):
        step(keep={"memory": {}})


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"graph": "main"}, "must be a list of steps; got dict"),
        (None, "must be a list of steps; got NoneType"),
        (["main"], "Step 0 of the program needs 'graph', 'feeds' and 'gives'"),
        ([{"graph": "main", "feeds": {}}], "Step 0 of the program needs"),
        ([{"graph": "main", "feeds": {}, "gives": {}, "repeats": 2}], "unknown key 'repeats'; did you mean 'repeat'"),
    ],
)
def test_a_program_of_another_form_is_refused(data, message):
    with pytest.raises(SpecError, match=message):
        program_from(data)


@pytest.mark.parametrize(
    "change",
    [{"feeds": ["x"]}, {"gives": "y"}, {"schedule": {"t": 3}}, {"noise": {"n": [1, 2]}}, {"carry": ["y"]}],
    ids=str,
)
def test_a_word_of_a_wrong_type_in_a_program_is_a_spec_error_and_no_traceback(change):
    data = [{"graph": "main", "feeds": {"a": "x"}, "gives": {"b": "y"}, **change}]
    with pytest.raises(SpecError):
        check_program(program_from(data), GRAPHS, SPEC)


def test_graphs_without_a_program_are_refused():
    with pytest.raises((BundleError, SpecError), match="program"):
        Manifest("plain", "1.0.0", SPEC, GRAPHS, (), FILES)
