from pathlib import Path

import onnx
import pytest

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import BundleError, GraphError, RecipeError
from vlatool.quantize.dynamic_int8 import DynamicInt8


def first(bundle: Bundle, op: str) -> str:
    """Name of the first node of an operator."""
    graph = onnx.load(bundle.path / "graphs/main.onnx").graph
    return next(node.name for node in graph.node if node.op_type == op)


def test_the_policy_runs_in_int8_and_stays_near_float(quantized, drift):
    bundle = quantized(DynamicInt8())
    assert Bundle.open(bundle.path) == bundle
    assert 0 < drift(bundle) < 0.05


def test_the_precision_is_counted_from_the_graph(quantized, operators):
    bundle = quantized(DynamicInt8())
    shares = bundle.manifest.graphs["main"].precision
    assert sum(shares.values()) == pytest.approx(1.0, abs=0.002)
    assert shares["int8"] > 0.3
    assert shares["float32"] > 0  # the convolution, and attention's product of two activations
    counts = operators(bundle)
    assert counts["Conv"] == 1
    assert counts["MatMulInteger"] >= 5


def test_the_weights_shrink(quantized, float_bundle):
    model = onnx.load(quantized(DynamicInt8()).path / "graphs/main.onnx")
    assert sum(tensor.data_type == onnx.TensorProto.INT8 for tensor in model.graph.initializer) >= 5


def test_equal_inputs_give_equal_bytes(quantized):
    one, two = quantized(DynamicInt8()), quantized(DynamicInt8())
    assert one.hash == two.hash
    assert hash_file(one.path / "graphs/main.onnx") == hash_file(two.path / "graphs/main.onnx")


def test_the_bundle_says_how_it_was_made(quantized, float_bundle):
    bundle = quantized(DynamicInt8(per_channel=False, reduce_range=True))
    assert bundle.manifest.parent == float_bundle.hash
    assert bundle.manifest.made_by["stage"] == "quantize.dynamic_int8"
    assert bundle.manifest.made_by["options"] == {"per_channel": False, "reduce_range": True}
    assert bundle.manifest.spec == float_bundle.manifest.spec


@pytest.mark.parametrize("op", ["MatMul", "Gemm"])
def test_an_excluded_node_stays_in_float(quantized, float_bundle, operators, op):
    name = first(float_bundle, op)
    all_of_them, but_one = quantized(DynamicInt8()), quantized(DynamicInt8(exclude=(name,)))
    assert operators(but_one)["MatMulInteger"] == operators(all_of_them)["MatMulInteger"] - 1
    shares = [bundle.manifest.graphs["main"].precision["int8"] for bundle in (but_one, all_of_them)]
    assert shares[0] < shares[1]


@pytest.mark.parametrize("op", ["MatMul", "Gemm"])
def test_only_the_included_node_is_quantized(quantized, float_bundle, operators, op):
    assert operators(quantized(DynamicInt8(include=(first(float_bundle, op),))))["MatMulInteger"] == 1


def test_exclude_wins_over_include(quantized, operators):
    bundle = quantized(DynamicInt8(include=("*",), exclude=("blocks.*", "state")))
    assert operators(bundle)["MatMulInteger"] == 1
    with pytest.raises(RecipeError, match="No layer is left to quantize: include, exclude and parts rule out all 7"):
        quantized(DynamicInt8(include=("*",), exclude=("*",)))


def test_parts_choose_layers_by_their_modules(quantized, operators):
    assert operators(quantized(DynamicInt8(parts=("head",))))["MatMulInteger"] == 1
    with pytest.raises(RecipeError, match="No layer is left"):
        quantized(DynamicInt8(parts=("vision",)))  # a convolution alone


@pytest.mark.parametrize("option", ["include", "exclude"])
def test_a_glob_that_matches_no_node_is_a_typing_error(quantized, option):
    with pytest.raises(RecipeError, match="No node matches 'no_such_node'; "):
        quantized(DynamicInt8(**{option: ("no_such_node",)}))


def test_a_glob_that_matches_no_graph_is_a_typing_error(float_bundle):
    with pytest.raises(RecipeError, match="No graph matches 'mian'; did you mean 'main'"):
        DynamicInt8(graphs=("mian",)).check(float_bundle, None)


def test_only_selected_graphs_are_quantized(float_bundle, quantized, tmp_path: Path, copied):
    """A second graph that no step runs stays as it is."""
    from dataclasses import replace

    from vlatool.bundle.bundle import seal
    from vlatool.bundle.manifest import Graph

    both = copied(float_bundle)
    (both.path / "graphs/other.onnx").write_bytes((both.path / "graphs/main.onnx").read_bytes())
    sealed = seal(both.path, both.manifest)
    graphs = {**sealed.manifest.graphs, "other": Graph("graphs/other.onnx", {"float32": 1.0}, 20)}
    both = seal(both.path, replace(sealed.manifest, graphs=graphs))
    made = quantized(DynamicInt8(graphs=("m*",)), both).manifest.graphs
    assert "int8" in made["main"].precision
    assert made["other"].precision == {"float32": 1.0}


def test_a_source_without_graphs_says_what_to_do_first(source_bundle):
    with pytest.raises(BundleError, match="no graph to quantize") as caught:
        DynamicInt8().check(source_bundle, None)
    assert "vlatool export" in caught.value.fix


def test_without_a_source_there_is_nothing_to_check():
    DynamicInt8().check(None, None)


def test_a_graph_that_the_quantizer_refuses_is_told(quantized, float_bundle, copied, resealed):
    bundle = copied(float_bundle)
    (bundle.path / "graphs/main.onnx").write_bytes(b"nonsense" * 10)
    with pytest.raises(GraphError, match="The graph 'main' cannot be quantized: ") as caught:
        quantized(DynamicInt8(), resealed(bundle))
    assert len(caught.value.message.splitlines()) == 1


def test_logging_and_the_current_directory_are_left_alone(quantized, tmp_path: Path, monkeypatch, capfd):
    import logging

    level = logging.getLogger().level
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    quantized(DynamicInt8())
    assert logging.getLogger().level == level
    assert list((tmp_path / "empty").iterdir()) == []
    assert capfd.readouterr() == ("", "")
