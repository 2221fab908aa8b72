"""The structure of vlatool: what is private stays private, no circles, and contracts that can fail."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from count import counts
from imports import PACKAGE, ROOT, circles, named_libraries, private_imports


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with its contracts, in which violations are planted."""
    place = tmp_path_factory.mktemp("planted")
    shutil.copytree(ROOT / PACKAGE, place / PACKAGE, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    shutil.copy(ROOT / "pyproject.toml", place)
    return place


def test_the_root_holds_few_modules():
    assert counts()["modules at the root"] <= 5


def test_test_files_have_names_of_their_own():
    """Pytest imports a test file by its name alone: two of one name are a collection error."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert {name for name in names if names.count(name) > 1} == set()


def test_what_is_private_stays_in_its_package():
    assert private_imports() == []


def test_no_circles():
    assert circles() == []


@pytest.mark.parametrize("planted", [
    "from vlatool.quantize import _qdq_forms", "from vlatool.quantize._base import load",
    "def late():\n    from vlatool.quantize import _base", "from vlatool.runtime.policy import _hidden",
    "from vlatool.runtime.engines._reference import ReferenceSession",
])  # fmt: skip
def test_a_private_import_is_seen(copy: Path, planted: str):
    target = copy / PACKAGE / "boards/planted.py"
    target.write_text(planted + "\n")
    try:
        assert [each.importer for each in private_imports(copy)] == ["vlatool.boards.planted"]
    finally:
        target.unlink()


def test_a_circle_is_seen(copy: Path):
    one, other = copy / PACKAGE / "boards/one.py", copy / PACKAGE / "boards/other.py"
    one.write_text("from vlatool.boards.other import x\n")
    other.write_text("def late():\n    import vlatool.boards.one\n")
    try:
        assert circles(copy) == [["vlatool.boards.one", "vlatool.boards.other"]]
    finally:
        one.unlink()
        other.unlink()


@pytest.mark.parametrize(("place", "planted", "broken"), [
    ("quantize/planted.py", "from vlatool.export.onnx import ExportOnnx", "layers"),
    ("files/planted.py", "from vlatool.bundle.bundle import Bundle", "layers"),
    ("planted/__init__.py", "", "layers"),
    ("optimize/judge.py", "from vlatool.optimize.choice import choose", "optimize reads"),
    ("bundle/planted.py", "def late():\n    import pydantic", "robot side"),
    ("runtime/planted.py", "from vlatool.stage.base import Stage", "robot side"),
    ("quantize/planted.py", "import onnxruntime", "inference libraries"),
])  # fmt: skip
def test_each_contract_can_fail(copy: Path, place: str, planted: str, broken: str):
    target = copy / PACKAGE / place
    before = target.read_text() if target.exists() else None
    target.parent.mkdir(exist_ok=True)
    target.write_text((before or "") + planted + "\n")
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()", "--no-cache"]
    try:
        done = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)
    finally:
        target.unlink() if before is None else target.write_text(before)
        if place.startswith("planted"):
            shutil.rmtree(target.parent)
    names = re.findall(r'^name = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    told = {name for name in names if f"{name} BROKEN" in " ".join(done.stdout.split())}
    assert done.returncode == 1, done.stdout + done.stderr
    assert any(broken in name for name in told), done.stdout


LIBRARIES = ("onnxruntime", "openvino", "tensorrt", "executorch")


def test_engines_alone_name_inference_libraries():
    assert named_libraries(LIBRARIES) == []


@pytest.mark.parametrize("planted", [
    "def late():\n    import onnxruntime.quantization", "from openvino import Core",
    "from vlatool.errors import require\nort = require('onnxruntime', 'ort')",
    "import importlib\nlibrary = importlib.import_module('openvino.runtime')",
])  # fmt: skip
def test_a_named_library_is_seen(copy: Path, planted: str):
    target = copy / PACKAGE / "quantize/planted.py"
    target.write_text(planted + "\n")
    try:
        assert named_libraries(LIBRARIES, copy) == [f"vlatool/quantize/planted.py:{len(planted.splitlines())}"]
    finally:
        target.unlink()
