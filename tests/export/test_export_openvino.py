"""OpenVINO's IR of a bundle: written, run, and compared with what the graphs say."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from _arithmetic import weights_of_this_host

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.data import recorded_observations
from vlatool.errors import GraphError
from vlatool.export.openvino import Openvino
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.runtime.golden import load_goldens
from vlatool.runtime.policy import relative_error
from vlatool.stage.base import Context, Result

openvino = pytest.importorskip("openvino")


def converted(bundle: Bundle, folder: Path, **options: object) -> Result:
    (folder / "ir").mkdir(parents=True)
    return Openvino(**options).run(bundle, folder / "ir", Context())


@pytest.fixture(scope="module")
def made(float_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return converted(float_bundle, tmp_path_factory.mktemp("openvino"))


def test_the_ir_gives_the_golden_action_with_openvino_alone(made: Result) -> None:
    bundle, known = made.bundle, json.loads((made.bundle.path / "openvino/interface.json").read_text())
    graph = known["graphs"]["main"]
    file = bundle.path / graph["files"]["model"]["file"]
    compiled = openvino.Core().compile_model(file, "CPU", graph["settings"])
    for observation, _, wanted in load_goldens(bundle):
        encoded = load(bundle.path).encode(observation)
        feeds = {port["name"]: np.asarray(encoded[port["spec_input"]]) for port in graph["inputs"]}
        assert [[*feeds[port["name"]].shape] for port in graph["inputs"]] == [port["shape"] for port in graph["inputs"]]
        assert relative_error(compiled(feeds)[graph["outputs"][0]["name"]], wanted) < 1e-3


def test_files_are_sealed_and_named_with_their_hashes(made: Result) -> None:
    known = json.loads((made.bundle.path / "openvino/interface.json").read_text())
    for each in known["graphs"]["main"]["files"].values():
        assert made.bundle.manifest.files[each["file"]].sha256 == each["sha256"]
        assert hash_file(made.bundle.path / each["file"]) == each["sha256"]
    assert [tensor["name"] for tensor in known["spec"]["inputs"]] == ["image", "proprio", "instruction"]
    assert "up to" in made.messages[0]


def test_the_bundle_beside_it_is_loaded_as_before(made: Result, float_bundle: Bundle) -> None:
    observation = recorded_observations(float_bundle, 1)[0]
    one, other = load(made.bundle.path, threads=1), load(float_bundle.path, threads=1)
    np.testing.assert_array_equal(one.infer(observation).chunk, other.infer(observation).chunk)


@pytest.mark.parametrize("layout", ["openvino", "qdq", "ort"])
def test_int8_pairs_are_converted_and_run(float_bundle: Bundle, tmp_path: Path, layout: str) -> None:
    (tmp_path / "int8").mkdir()
    stage = StaticInt8(layout=layout, **weights_of_this_host("openvino"))
    int8 = stage.run(float_bundle, tmp_path / "int8", Context()).bundle
    result = converted(int8, tmp_path)
    weights = (result.bundle.path / "openvino/main.bin").stat().st_size
    assert 0 < weights < 0.6 * (float_bundle.path / "graphs/main.onnx").stat().st_size


def test_what_openvino_does_not_take_is_refused_with_a_remedy(tmp_path: Path) -> None:
    text = (
        '<ir_version: 10, opset_import: ["" : 20, "mine" : 1]> g (float[1,3] x) => (float[1,3] y) { y = mine.Odd(x) }'
    )
    onnx.save(onnx.parser.parse_model(text), tmp_path / "g.onnx")
    with pytest.raises(GraphError, match=r"OpenVINO does not take the graph g\.onnx: .*Odd") as caught:
        Openvino()._convert(tmp_path / "g.onnx", tmp_path / "g.xml")
    assert "--layout openvino" in caught.value.fix


def test_a_tolerance_that_is_too_small_is_an_error(float_bundle: Bundle, tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=r"relative L2 error .* allowed 1e-12"):
        converted(float_bundle, tmp_path, tolerance=1e-12)


def test_the_fix_is_not_what_was_done_already(float_bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "int8").mkdir()
    int8 = StaticInt8(layout="openvino").run(float_bundle, tmp_path / "int8", Context()).bundle
    with pytest.raises(GraphError, match="relative L2 error") as caught:
        converted(int8, tmp_path, tolerance=1e-12)
    assert "round otherwise on this processor" in caught.value.fix
    assert "--layout openvino" not in caught.value.fix
