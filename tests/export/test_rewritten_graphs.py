"""Bundles that are rewritten for another engine keep the files of their graphs, wherever those lie."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from _flow import write_flow

from vlatool.bundle.bundle import Bundle, seal
from vlatool.export.onnx import ExportOnnx
from vlatool.export.openvino import Openvino
from vlatool.export.opset import Opset
from vlatool.export.tensorrt import Tensorrt
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context, Transform
from vlatool.stage.run import run_transform


@pytest.fixture(scope="module")
def nested(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A bundle of several graphs in folders of their own, in files of one name; read only."""
    folder = tmp_path_factory.mktemp("nested")
    source = run_transform(TorchModule(policy=write_flow(folder / "flow")), None, folder / "source", Context()).bundle
    made = run_transform(ExportOnnx(), source, folder / "bundle", Context()).bundle
    graphs, files = {}, dict(made.manifest.files)
    for name, graph in made.manifest.graphs.items():
        (made.path / "graphs" / name).mkdir()
        shutil.move(made.path / graph.file, made.path / f"graphs/{name}/graph.onnx")
        files[f"graphs/{name}/graph.onnx"] = files.pop(graph.file)
        graphs[name] = replace(graph, file=f"graphs/{name}/graph.onnx")
    return seal(made.path, replace(made.manifest, graphs=graphs, files=files))


@pytest.mark.parametrize("stage", [Opset(ir_version=9), Openvino(), Tensorrt()], ids=lambda stage: stage.name())
def test_graphs_of_one_file_name_stay_apart(nested: Bundle, tmp_path: Path, stage: Transform):
    if stage.name() == "export.openvino":
        pytest.importorskip("openvino")
    before = {name: nested.file(graph.file).read_bytes() for name, graph in nested.manifest.graphs.items()}
    (tmp_path / "out").mkdir()
    made = stage.run(nested, tmp_path / "out", Context()).bundle
    assert {name: graph.file for name, graph in made.manifest.graphs.items()} == {
        name: graph.file for name, graph in nested.manifest.graphs.items()
    }
    assert len({made.file(graph.file).read_bytes() for graph in made.manifest.graphs.values()}) == len(before) > 1
    assert before == {name: nested.file(graph.file).read_bytes() for name, graph in nested.manifest.graphs.items()}
    load(made.path, threads=1)
