"""Reading ONNX files that are none."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.errors import GraphError
from vlatool.graph.files import read


@pytest.mark.parametrize("content", [b"\xff" * 100, b"PK\x03\x04" + bytes(200)])
def test_a_file_that_is_no_onnx_is_named(tmp_path: Path, content: bytes):
    (tmp_path / "main.onnx").write_bytes(content)
    with pytest.raises(GraphError, match=r"main\.onnx cannot be read as an ONNX file"):
        read(tmp_path / "main.onnx")
