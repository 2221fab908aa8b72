"""Weights beside a graph are in memory once after OpenVINO has packed them."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
import pytest

from vlatool.runtime.engines import _mapped_weights
from vlatool.runtime.engines._mapped_weights import drop_mapped_pages
from vlatool.runtime.engines.openvino import OpenvinoSession

LOOKED_UP = """<ir_version: 10, opset_import: ["" : 20]>
g (int64[1] row) => (float[1,512] y) { x = Gather(table, row) y = MatMul(x, w) }"""


def resident_bytes(file: Path) -> int:
    """Return how much of a file this process has in memory through mappings."""
    resident, mine = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if "-" in line.split()[0]:
            mine = line.endswith(str(file))
        elif mine and line.startswith("Rss:"):
            resident += int(line.split()[1]) * 1024
    return resident


def test_openvino_keeps_no_second_copy_of_what_it_packed(tmp_path: Path) -> None:
    model = onnx.parser.parse_model(LOOKED_UP)
    random = np.random.default_rng(0)
    table, weights = (random.standard_normal(shape).astype(np.float32) for shape in ((4096, 1024), (1024, 512)))
    model.graph.initializer.extend(
        onnx.numpy_helper.from_array(value, name) for name, value in (("table", table), ("w", weights))
    )
    path, data = tmp_path / "graph.onnx", tmp_path / "graph.data"
    onnx.save(model, path, save_as_external_data=True, location=data.name)
    session = OpenvinoSession(path, 1)
    assert data.stat().st_size > 18e6
    assert resident_bytes(data) < 4e6
    for row in (0, 4095, 7):
        got = session.run({"row": np.array([row])})["y"]
        np.testing.assert_allclose(got[0], table[row] @ weights, rtol=1e-3, atol=1e-3)


def test_only_what_cannot_be_written_is_dropped(tmp_path: Path) -> None:
    (tmp_path / "beside").write_bytes(b"a" * 8192)
    (other := tmp_path / "elsewhere").mkdir()
    (other / "file").write_bytes(b"b" * 8192)
    handles = [file.open("r+b") for file in (tmp_path / "beside", other / "file")]
    private, read, foreign = (
        mmap.mmap(handle.fileno(), 0, access=access)
        for handle, access in ((handles[0], mmap.ACCESS_COPY), *((each, mmap.ACCESS_READ) for each in handles))
    )
    private[:4] = b"kept"
    assert (read[0], foreign[0]) == (ord("a"), ord("b"))
    assert drop_mapped_pages(tmp_path) == 8192
    assert (private[:5], read[:4], foreign[:4]) == (b"kepta", b"aaaa", b"bbbb")
    for opened in (private, read, foreign, *handles):
        opened.close()


def test_where_the_kernel_lists_nothing_nothing_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_mapped_weights, "MAPS", tmp_path / "absent")
    assert drop_mapped_pages(tmp_path) == 0
    assert drop_mapped_pages(tmp_path / "absent") == 0
