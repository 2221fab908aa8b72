import json

import pytest
from _edits import put

from vlatool.bundle.manifest import FileRecord, Graph, Manifest, check_files
from vlatool.bundle.program import ProgramStep, check_program, program_from, single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError, SpecError

SPEC = PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 2)),), 10.0)
GRAPHS = {"main": Graph("graphs/main.onnx", {"float32": 1.0}, 20)}
FILES = {"graphs/main.onnx": FileRecord("0" * 64, 3)}
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
        {graph.file: FileRecord("1" * 64, 5) for graph in DIFFUSION_GRAPHS.values()},
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


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ([], "The manifest has the unknown key 'folden'; did you mean 'golden'"),
        (["graphs", "main"], "The graph 'main' has the unknown key 'folden'"),
        (["program", 0], "Step 0 of the program has the unknown key 'folden'"),
        (["files", "graphs/main.onnx"], "The record of 'graphs/main.onnx' has the unknown key 'folden'"),
        (["spec"], "The spec has the unknown key 'folden'"),
        (["spec", "inputs", 0], "The tensor 'x' has the unknown key 'folden'"),
    ],
    ids=str,
)
def test_an_unknown_key_is_refused_at_every_level(where, message):
    data = json.loads(json.dumps(MANIFESTS[1].to_dict()))
    put(*where, "folden", "golden/golden.npz")(data)
    with pytest.raises((BundleError, SpecError), match=message):
        Manifest.from_dict(data)


@pytest.mark.parametrize(("entry", "word"), [(0, "keep"), (1, "noise")])
def test_an_unknown_key_of_noise_or_a_kept_value_is_refused(entry, word):
    data = json.loads(json.dumps(DIFFUSION))
    next(iter(data[entry][word].values()))["colour"] = "red"
    with pytest.raises(SpecError, match="has the unknown key 'colour'"):
        program_from(data)


def test_a_newer_schema_asks_for_an_upgrade():
    with pytest.raises(BundleError, match="schema 4; this vlatool reads up to 3") as caught:
        Manifest.from_dict({**MANIFESTS[1].to_dict(), "schema": 4})
    assert caught.value.fix == "upgrade vlatool"


@pytest.mark.parametrize("schema", [None, "1", 0, 1.5])
def test_an_impossible_schema_is_refused(schema):
    with pytest.raises(BundleError, match="this vlatool reads 1 to 3"):
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
        {"files": {"graphs/main.onnx": {"sha256": "0" * 64, "bytes": True}}},
        {"files": {"graphs/main.onnx": {"sha256": "0" * 64, "bytes": -1}}},
        {"files": {"graphs/main.onnx": {"sha256": "0" * 64, "bytes": float("nan")}}},
        {"files": {"graphs/main.onnx": {"sha256": "0" * 64, "bytes": 2**70}}},
        {"files": {"graphs/main.onnx": {"sha256": "0" * 63 + "G", "bytes": 3}}},
        {"files": {"graphs/main.onnx": {"sha256": ["0" * 64], "bytes": 3}}},
        {"name": 3},
        {"name": ""},
        {"version": None},
        {"engine": ["ort_cpu"]},
        {"golden": {"file": "golden/golden.npz"}},
        {"parent": True},
        {"build": {"stage": "x"}},
        {"build": [["stage"]]},
        {"build": [{"stage": 3}]},
        {"parts": {"head": "head*"}},
        {"parts": {"head": [1]}},
        {"accuracy": {"success": {"value": True}}},
        {"accuracy": {"success": {"value": float("nan")}}},
        {"accuracy": {"success": {"value": 10**400}}},
        {"made_by": []},
        {"description": "\ud800"},
        {"schema": True},
        {"graphs": {"main": {"file": "graphs/main.onnx", "precision": {"float32": "all"}}}},
        {"graphs": {"main": {"file": "graphs/main.onnx", "precision": {"float32": 2}}}},
        {"graphs": {"main": {"file": "graphs/main.onnx", "opset": 2.5}}},
        {"graphs": {"main": {"file": "graphs/main.onnx", "compute": ["float32"]}}},
        {"graphs": {str(number): {"file": "graphs/main.onnx"} for number in range(300)}},
        {"program": [{"graph": "main", "feeds": {"x": "x"}, "gives": {"y": "y"}, "schedule": 3}]},
        {"program": [{"graph": "main", "feeds": ["x"], "gives": ["y"]}]},
    ],
    ids=lambda change: ascii(change)[:60],
)
def test_a_malformed_manifest_is_the_bundles_fault_and_no_traceback(change):
    with pytest.raises((BundleError, SpecError)):
        Manifest.from_dict({**MANIFESTS[1].to_dict(), **change})


@pytest.mark.parametrize(
    "path",
    ["../main.onnx", "/etc/passwd", "graphs/../../main.onnx", "", "a\\b", "a\0b", "./a", "a//b", "*/_ORT_MEM_ADDR_/*"],
)
def test_a_path_that_leaves_the_bundle_is_refused(path):
    with pytest.raises(BundleError, match="not inside the bundle"):
        Manifest("evil", "1", SPEC, files={path: FileRecord("0" * 64, 3)})
    with pytest.raises(BundleError, match="not inside the bundle"):
        Manifest("evil", "1", SPEC, {"main": Graph(path)}, files={})


@pytest.mark.parametrize("name", ["../../../main", "/tmp/main", "graphs/main", "..", "a\nb", "a\0b", "x" * 201, "a:b"])
def test_a_graph_whose_name_is_a_path_is_refused(name):
    """Exporters write files that are called after the graphs."""
    record = {"graphs/main.onnx": FileRecord("0" * 64, 3)}
    with pytest.raises(SpecError, match="A graph has the name"):
        step(graph=name)
    with pytest.raises(BundleError, match="A graph has the name"):
        Manifest("evil", "1", SPEC, {"main": Graph("graphs/main.onnx"), name: Graph("graphs/main.onnx")},
                 single_graph(SPEC), record)  # fmt: skip


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
        ({"repeat": True}, "repeats 'main' True times"),
        ({"repeat": 10_000_000}, "10000000 runs; the limit 'repeat' allows 10000"),
        ({"repeat": 2**70}, "more than 2.* runs; the limit 'repeat'"),
        ({"schedule": {"t": [float("nan")]}}, "schedule of 't' must be a number"),
        ({"schedule": {"t": ["1"]}}, "schedule of 't' must be a number"),
        ({"schedule": {"t": [2**64]}}, "no int64 holds"),
        ({"noise": {"n": {"shape": [1 << 30]}}}, "the limit 'elements'"),
        ({"noise": {"n": {"shape": [1.5]}}}, "An axis of the shape of the noise 'n' must be a whole number"),
        ({"noise": {"n": {"shape": [-1]}}}, "An axis of the shape of the noise 'n'"),
        ({"noise": {"n": {"shape": "12"}}}, "the shape of the noise 'n' must be a list"),
        ({"keep": {"k": {"shape": [1 << 20, 1 << 20]}}}, "the limit 'elements'"),
        ({"keep": {"k": {"shape": [1], "dtype": "object"}}}, "dtype 'object'; allowed: float32"),
        ({"keep": {"k": {"shape": [True]}}}, "An axis of the shape of the kept value 'k'"),
        ({"feeds": {"a": 3}}, "A value in 'feeds' of 'main' must be text"),
        ({"feeds": {3: "x"}}, "A key of 'feeds' of 'main' must be text"),
        ({"graph": ["main"]}, "The graph of a step must be text"),
        ({"repeat": 3, "schedule": {"t": [1, 2]}}, "schedule of 't' has 2 numbers, but 'main' runs 3 times"),
        ({"noise": {"n": {}}}, "noise 'n' needs a shape"),
        ({"noise": {"n": {"shape": [1], "distribution": "cauchy"}}}, "distribution of normal, uniform, zeros"),
    ],
)
def test_an_impossible_step_is_refused(changes, message):
    with pytest.raises(SpecError, match=message):
        step(**changes)


def test_a_program_of_too_many_runs_steps_or_values_is_refused():
    with pytest.raises(SpecError, match="200000 runs; the limit 'runs' allows 100000"):
        check_program([step(repeat=10_000)] * 20, GRAPHS, SPEC)
    with pytest.raises(SpecError, match="1025 steps; the limit 'steps' allows 1024"):
        check_program([step()] * 1025, GRAPHS, SPEC)
    kept = [step(keep={f"k{number}": {"shape": [1 << 26]}}) for number in range(3)]
    with pytest.raises(SpecError, match="the limit 'state_elements'"):
        check_program(kept, GRAPHS, SPEC)


def test_what_the_manifest_names_needs_a_record():
    text = TensorSpec("say", (1, 5), "int64", "text", tokenizer="words.json", max_tokens=5)
    state = TensorSpec("x", (1, 2), normalisation="mean_std", statistics="stats.json#x")
    spec = PolicySpec((text, state), SPEC.outputs, 10.0)
    for missing in ("words.json", "stats.json"):
        others = {f"assets/{name}": FileRecord("0" * 64, 1) for name in {"words.json", "stats.json"} - {missing}}
        manifest = Manifest("plain", "1", spec, GRAPHS, (step(gives={"b": "y"}),), {**FILES, **others})
        with pytest.raises(BundleError, match=f"names assets/{missing}, which '(say|x)' needs, but records no hash"):
            check_files(manifest)


@pytest.mark.parametrize(("kept", "got"), [({}, "None"), ({"shape": []}, r"\[\]"), ([1, 2], r"\[1, 2\]"), (0, "0")])
def test_a_kept_value_needs_a_shape(kept: object, got: str):
    with pytest.raises(SpecError, match=f"'memory' needs a shape of one axis or more; got {got}") as caught:
        step(keep={"memory": kept})
    assert caught.value.fix.startswith("write it as memory: {shape: [1], dtype: float32}")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"graph": "main"}, "must be a list of steps; got dict"),
        (None, "must be a list of steps; got NoneType"),
        (["main"], "Step 0 of the program lacks 'graph', 'feeds' or 'gives'"),
        ([{"graph": "main", "feeds": {}}], "Step 0 of the program lacks"),
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
