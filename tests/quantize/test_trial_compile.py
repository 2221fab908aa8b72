"""A graph that crashes OpenVINO becomes an error, not the end of the process."""

import contextlib
from pathlib import Path

import onnx
import onnx.parser
import pytest

from vlatool.errors import GraphError
from vlatool.quantize import _trial_compile
from vlatool.quantize._trial_compile import open_in_child
from vlatool.quantize.static_int8 import StaticInt8


def test_a_sound_graph_passes(tmp_path: Path) -> None:
    text = '<ir_version: 10, opset_import: ["" : 20]> g (float[1,3] x) => (float[1,3] y) { y = Add(x, x) }'
    onnx.save(onnx.parser.parse_model(text), str(tmp_path / "g.onnx"))
    open_in_child(tmp_path / "g.onnx", "openvino", "int8", "quantize fewer")


def test_a_file_that_is_refused_is_left_to_the_engine(tmp_path: Path) -> None:
    (tmp_path / "g.onnx").write_bytes(b"no graph")
    open_in_child(tmp_path / "g.onnx", "openvino", "int8", "quantize fewer")


def test_a_child_that_is_killed_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_trial_compile, "CHILD_CODE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    for engine, title in (("openvino", "OpenVINO"), ("", "ONNX Runtime")):
        with pytest.raises(GraphError, match=f"{title} crashes \\(signal 11\\)") as caught:
            open_in_child(tmp_path / "g.onnx", engine, "int8", "quantize fewer")
        assert caught.value.fix == "quantize fewer"


def test_residual_sums_of_the_tiny_policy_give_a_bundle_or_an_error(quantized) -> None:
    """OpenVINO 2026.4 dies of it; a later one may not."""
    made = None
    with contextlib.suppress(GraphError):
        made = quantized(StaticInt8(layout="openvino", elementwise=True, samples=8))
    assert made is None or made.manifest.engine == "openvino"
