import contextlib
import os
import random
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.errors import GraphError
from vlatool.runtime.external_data import SEARCH_BYTES, OpenFile, external_files


def external(name: str, location: str) -> onnx.TensorProto:
    tensor = numpy_helper.from_array(np.ones(4, np.float32), name)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("offset", "0"), ("location", location), ("length", "16")):
        tensor.external_data.add(key=key, value=value)
    return tensor


def constant(location: str, name: str = "c") -> onnx.NodeProto:
    return helper.make_node("Constant", [], [name], value=external(name, location))


def graph_of(*nodes: onnx.NodeProto, initializer: tuple[onnx.TensorProto, ...] = ()) -> onnx.GraphProto:
    return helper.make_graph(list(nodes), "main", [], [helper.make_tensor_value_info("c", 1, (4,))], list(initializer))


def branching(location: str) -> onnx.NodeProto:
    branch = graph_of(constant(location))
    return helper.make_node(
        "If", ["flag"], ["c"], then_branch=branch, else_branch=graph_of(constant(f"else-{location}"))
    )


def model_of(graph: onnx.GraphProto) -> onnx.ModelProto:
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)


def everywhere() -> onnx.ModelProto:
    """A model that keeps weights in every place where ONNX lets it."""
    sparse = helper.make_sparse_tensor(external("sparse", "values.data"), external("where", "indices.data"), [9])
    lists = helper.make_node("Lists", [], ["d"], domain="own")
    lists.attribute.append(helper.make_attribute("tensors", [external("one", "tensors.data")]))
    lists.attribute.append(helper.make_attribute("graphs", [graph_of(constant("graphs.data"))]))
    lists.attribute.append(helper.make_attribute("sparse", sparse))
    lists.attribute.append(helper.make_attribute("sparses", [sparse]))
    deep = helper.make_node("If", ["flag"], ["c"], then_branch=graph_of(branching("deep.data")), else_branch=graph_of())
    graph = graph_of(branching("branch.data"), deep, lists, initializer=(external("w", "weights.data"),))
    graph.sparse_initializer.append(sparse)
    model = model_of(graph)
    function = helper.make_function("own", "f", [], ["c"], [constant("function.data")], [helper.make_opsetid("", 20)])
    function.attribute_proto.append(helper.make_attribute("value", external("default", "default.data")))
    model.functions.append(function)
    training = model.training_info.add()
    training.initialization.CopyFrom(graph_of(constant("initialization.data")))
    training.algorithm.CopyFrom(graph_of(constant("algorithm.data")))
    return model


PLACES = {
    "weights.data", "branch.data", "else-branch.data", "deep.data", "else-deep.data", "tensors.data", "graphs.data",
    "values.data", "indices.data", "function.data", "default.data", "initialization.data", "algorithm.data",
}  # fmt: skip


def test_every_place_where_a_model_may_keep_weights_is_found():
    assert external_files(everywhere().SerializeToString()) == PLACES


def large() -> onnx.ModelProto:
    """The same model with much between its weights, some of which read like the key."""
    model = everywhere()
    values = np.frombuffer(b"location" * SEARCH_BYTES, np.float32)
    for number in range(8):
        model.graph.initializer.insert(0, numpy_helper.from_array(values, f"large_{number}"))
        value = numpy_helper.from_array(values, f"constant_{number}")
        model.graph.node.insert(0, helper.make_node("Constant", [], [f"constant_{number}"], value=value))
    return model


def in_file(content: bytes, folder: Path) -> set[str]:
    path = folder / "model.onnx"
    path.write_bytes(content)
    with path.open("rb") as stream:
        return external_files(OpenFile(stream.fileno()))


def test_of_an_open_file_the_data_of_large_tensors_are_not_read(tmp_path, monkeypatch):
    content = large().SerializeToString()
    assert external_files(content) == PLACES
    read = []
    true = os.pread
    monkeypatch.setattr(os, "pread", lambda handle, size, at: read.append(size) or true(handle, size, at))
    assert in_file(content, tmp_path) == PLACES
    assert len(content) > 2_000_000 > 2 * sum(read)


def test_a_file_that_becomes_shorter_meanwhile_is_told(tmp_path, monkeypatch):
    path = tmp_path / "model.onnx"
    path.write_bytes(large().SerializeToString())
    with path.open("rb") as stream:
        opened = OpenFile(stream.fileno())
        os.truncate(path, 1_000_000)
        with pytest.raises(GraphError, match="ends within a number"):
            external_files(opened)


def test_a_model_without_external_data_has_none():
    model = model_of(graph_of(helper.make_node("Relu", ["location"], ["c"], name="location")))
    assert external_files(model.SerializeToString()) == set()


def test_two_messages_one_after_the_other_are_merged_as_protobuf_does():
    first, second = model_of(graph_of(constant("first.data"))), model_of(graph_of(constant("second.data")))
    content = first.SerializeToString() + second.SerializeToString()
    assert len(onnx.ModelProto.FromString(content).graph.node) == 2
    assert external_files(content) == {"first.data", "second.data"}


def test_of_a_key_or_a_value_that_occurs_twice_every_one_counts():
    tensor = external("w", "a.data")
    tensor.external_data[1].MergeFromString(b"\x12\x06b.data")
    content = model_of(graph_of(initializer=(tensor,))).SerializeToString()
    assert external_files(content) == {"b.data"}
    twice = b"\x0a\x08location\x12\x06a.data\x12\x06b.data"
    assert external_files(wrapped(twice)) == {"a.data", "b.data"}
    assert external_files(wrapped(b"\x0a\x08location\x0a\x03off\x12\x06b.data")) == {"b.data"}
    assert external_files(wrapped(b"\x0a\x08location")) == {""}


def wrapped(entry: bytes) -> bytes:
    """A model whose one initialiser has that one entry of external data."""
    for tag in (b"\x6a", b"\x2a", b"\x3a"):
        entry = tag + bytes([len(entry)]) + entry
    return entry


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x3a\x7flocation", "a part of it is longer than the whole"),
        (wrapped(b"\x0a\x08location\x12\x01\xff"), "not UTF-8"),
        (b"location\x0b", "an unknown kind"),
        (b"\x12\x08location\x80", "ends within a number"),
        (b"\x80\x80\x80\x80\x80\x80\x80location", "a number in it is too long"),
        (b"\x12\x08location\x05", "an unknown kind"),
    ],
)
def test_what_is_no_model_is_told(content, message):
    with pytest.raises(GraphError, match=message):
        external_files(content)


def test_a_graph_of_too_many_levels_or_parts_is_refused(monkeypatch):
    chain = b"\x12\x08location"
    for _ in range(60):
        chain = nested(1, nested(5, nested(6, chain)))
    with pytest.raises(GraphError, match="the limit 'graph_depth'"):
        external_files(nested(7, chain))
    monkeypatch.setenv("VLATOOL_LIMITS", "graph_fields=10")
    with pytest.raises(GraphError, match="the limit 'graph_fields'"):
        external_files(everywhere().SerializeToString())


def nested(field: int, content: bytes) -> bytes:
    size, length = len(content), b""
    while size >= 128:
        length, size = length + bytes([size & 127 | 128]), size >> 7
    return bytes([field << 3 | 2]) + length + bytes([size]) + content


def test_whatever_protobuf_reads_from_a_damaged_model_is_found(tmp_path):
    """Fuzz: what onnx finds in a damaged model, the walk finds, too, or refuses the model."""
    chance = random.Random(0)
    original = everywhere().SerializeToString()
    agreed = 0
    for _ in range(2000):
        content = bytearray(original)
        for _ in range(chance.choice((1, 1, 2, 4))):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        with contextlib.suppress(GraphError):
            found = external_files(bytes(content))
            assert in_file(bytes(content), tmp_path) == found
            with contextlib.suppress(Exception):
                agreed += locations(onnx.ModelProto.FromString(bytes(content))) <= found or pytest.fail("missed one")
    assert agreed > 100


def locations(message: object) -> set[str]:
    """Every location in a message, by protobuf's own reflection."""
    found: set[str] = set()
    for field, value in message.ListFields():
        if field.message_type is None:
            continue
        for item in value if field.is_repeated else [value]:
            if field.name == "external_data" and field.containing_type.name == "TensorProto":
                found |= {item.value} if item.key == "location" else set()
            else:
                found |= locations(item)
    return found
