"""The table of networks in wheels, in its small form: a wheel with a file that is right, and one that is refused."""

import contextlib
import io
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import wheels
from onnx import TensorProto, helper, numpy_helper

from vlatool.cli import main


def file_of(path: Path, kind: str) -> Path:
    weight = numpy_helper.from_array(np.ones((4, 2), np.float32), "w")
    domain = "" if kind == "MatMul" else "elsewhere"
    node = helper.make_node(kind, ["x", "w"], ["y"], "layer", domain=domain)
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size]) for name, size in (("x", 4), ("y", 2))]
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("elsewhere", 1)]
    graph = helper.make_graph([node], "g", ends[:1], ends[1:], [weight])
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), path)
    return path


def here(line: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
    """Run a command line of vlatool in this process instead of one of its own."""
    out, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(told), pytest.raises(SystemExit) as left:
        main(line[3:])
    return subprocess.CompletedProcess(line, int(left.value.code or 0), out.getvalue(), told.getvalue())


def test_right_and_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wheels").mkdir()
    with zipfile.ZipFile(tmp_path / "wheels/nets-1.0-py3-none-any.whl", "w") as archive:
        for name, kind in (("right", "MatMul"), ("custom", "Warp")):
            archive.write(file_of(tmp_path / f"{name}.onnx", kind), f"nets/{name}.onnx")
    monkeypatch.setattr(wheels, "SAMPLES", 3)
    monkeypatch.setattr(wheels, "subprocess", SimpleNamespace(run=here))
    monkeypatch.setattr(sys, "argv", ["wheels.py", str(tmp_path / "wheels"), "-o", str(tmp_path / "out")])
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    assert wheels.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert 'nets 1.0 `custom.onnx` | refused: "error: ' in lines[2]
    assert "operator Warp of the domain 'elsewhere' at 'layer'" in lines[2]
    assert "nets 1.0 `right.onnx` | works | 0.0e+00 |" in lines[3]
