import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Graph, Manifest
from vlatool.bundle.program import single_graph
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import BundleError, GraphError
from vlatool.registry import load as engine_of
from vlatool.runtime import graph_files, load
from vlatool.runtime.graph_files import open_graph

SPEC = PolicySpec((TensorSpec("x", (1, 2)),), (TensorSpec("y", (1, 3)),), 10.0)
WEIGHT = np.arange(6, dtype=np.float32).reshape(2, 3)
ENGINES = ("ort_cpu", "openvino")


def product(file: Path, weight: np.ndarray = WEIGHT, location: str = "") -> None:
    """``y = x @ weight``; the weight in a file beside the graph where there is a location."""
    tensor = numpy_helper.from_array(weight, "w")
    if location:
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=location)
    node = helper.make_node("MatMul", ["x", "w"], ["y"])
    value = helper.make_tensor_value_info
    graph = helper.make_graph([node], "m", [value("x", 1, (1, 2))], [value("y", 1, (1, 3))], [tensor])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    file.write_bytes(model.SerializeToString())


def bundle_of(folder: Path, location: str = "main.data", file: str = "graphs/main.onnx") -> Bundle:
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    product(folder / file, location=location)
    if location:
        ((folder / file).parent / "main.data").write_bytes(WEIGHT.tobytes())
    sealed = seal(folder, Manifest("m", "1", SPEC, program=single_graph(SPEC)))
    return seal(folder, replace(sealed.manifest, graphs={"main": Graph(file)}))


def answer(bundle: Bundle, engine: str = "ort_cpu") -> Any:
    session = open_graph(bundle, bundle.manifest.graphs["main"], engine_of("engines", engine), 1)
    return session.run({"x": np.array([[1, 2]], np.float32)})["y"].tolist()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("location", ["", "main.data"])
@pytest.mark.parametrize("file", ["graphs/main.onnx", "main.onnx", "a/b/main.onnx"])
@pytest.mark.parametrize("whole", [0, 1 << 20])
def test_a_graph_computes_the_same_however_it_is_opened(tmp_path: Path, monkeypatch, engine, location, file, whole):
    monkeypatch.setattr(graph_files, "WHOLE", whole)
    assert answer(bundle_of(tmp_path, location, file), engine) == [[6.0, 9.0, 12.0]]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_relative_path_to_a_bundle_is_one(tmp_path: Path, monkeypatch, engine):
    bundle_of(tmp_path / "bundle")
    monkeypatch.chdir(tmp_path)
    assert answer(Bundle.open("bundle"), engine) == [[6.0, 9.0, 12.0]]


@pytest.mark.parametrize(
    ("location", "reason"),
    [
        ("other.data", "the manifest does not record it"),
        ("../main.data", "it leaves the directory"),
        ("../graphs/main.data", "it leaves the directory"),
        ("/etc/hostname", "it is absolute"),
        ("./main.data", "empty or a dot"),
        ("*/_ORT_MEM_ADDR_/*", "characters that no file"),
    ],
)
@pytest.mark.parametrize("whole", [0, 1 << 20])
def test_weights_that_the_manifest_does_not_record_are_refused(tmp_path: Path, monkeypatch, location, reason, whole):
    monkeypatch.setattr(graph_files, "WHOLE", whole)
    bundle = bundle_of(tmp_path / "bundle", location)
    with pytest.raises(BundleError, match=f"keeps weights in '.*': .*{reason}"):
        answer(bundle)


def test_weights_are_not_looked_for_where_the_process_runs(tmp_path: Path, monkeypatch):
    bundle = bundle_of(tmp_path / "bundle", "elsewhere.data")
    (tmp_path / "elsewhere.data").write_bytes((-WEIGHT).tobytes())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BundleError, match="does not record"):
        load(bundle.path)


def test_negated_weights_beside_a_graph_are_refused(tmp_path: Path):
    bundle = bundle_of(tmp_path)
    (tmp_path / "graphs/main.data").write_bytes((-WEIGHT).tobytes())
    with pytest.raises(BundleError, match=r"main.data has changed"):
        answer(bundle)


def test_weights_beside_a_graph_count_and_may_be_no_link(tmp_path: Path):
    bundle = bundle_of(tmp_path / "bundle")
    assert bundle.graph_bytes == sum(file.stat().st_size for file in (bundle.path / "graphs").iterdir())
    shutil.move(bundle.path / "graphs/main.data", tmp_path / "main.data")
    (bundle.path / "graphs/main.data").symlink_to(tmp_path / "main.data")
    with pytest.raises(BundleError, match="missing, or a link"):
        answer(bundle)


class Swapper:
    """An engine during whose opening somebody writes."""

    def __init__(self, path: Path, threads: int | None, compute: str, opened: Any) -> None:
        folder = path.parent
        (folder / "main.data").rename(folder / "away")
        (folder / "main.data").write_bytes((-WEIGHT).tobytes())
        self.session = engine_of("engines", "ort_cpu")(path, threads, compute, opened)
        os.replace(folder / "away", folder / "main.data")


def test_weights_that_are_swapped_while_the_engine_opens_them_are_seen(tmp_path: Path):
    bundle = bundle_of(tmp_path)
    with pytest.raises(BundleError, match="was changed while"):
        open_graph(bundle, bundle.manifest.graphs["main"], Swapper, 1)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_engine_does_not_see_what_takes_the_graphs_place(tmp_path: Path, engine):
    bundle = bundle_of(tmp_path, "")

    def late(path: Path, threads: int | None, compute: str, opened: Any) -> Any:
        product(path, -WEIGHT)
        return engine_of("engines", engine)(path, threads, compute, opened)

    session = open_graph(bundle, bundle.manifest.graphs["main"], late, 1)
    assert session.run({"x": np.array([[1, 2]], np.float32)})["y"].tolist() == [[6.0, 9.0, 12.0]]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_graph_that_is_none_is_the_graphs_fault(tmp_path: Path, engine):
    bundle = bundle_of(tmp_path, "")
    (tmp_path / "graphs/main.onnx").write_bytes(b"no graph")
    with pytest.raises(GraphError, match=r"refuses .*graphs/main.onnx"):
        answer(seal(tmp_path, bundle.manifest), engine)


def test_the_content_of_a_graph_is_not_kept(tmp_path: Path):
    bundle = bundle_of(tmp_path, "")
    session = open_graph(bundle, bundle.manifest.graphs["main"], engine_of("engines", "ort_cpu"), 1)
    assert not session._session._model_bytes


def test_onnx_and_the_walk_agree_on_a_saved_model(tmp_path: Path):
    bundle = bundle_of(tmp_path)
    model = onnx.load(tmp_path / "graphs/main.onnx")
    onnx.save(model, tmp_path / "graphs/main.onnx", save_as_external_data=True, location="new.data", size_threshold=0)
    (tmp_path / "graphs/main.data").unlink()
    assert answer(seal(tmp_path, bundle.manifest)) == [[6.0, 9.0, 12.0]]
