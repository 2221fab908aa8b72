"""What TensorRT builds is kept by all that makes it invalid; the library itself is not here, so its session is not."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import onnx
import onnx.parser
import pytest

import vlatool
from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.errors import GraphError
from vlatool.runtime.contract import input_shapes
from vlatool.runtime.engines import ort_tensorrt
from vlatool.runtime.engines._engine_cache import EngineCache
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.engines.ort_tensorrt import OrtTensorrtSession

FLOATS = '<ir_version: 10, opset_import: ["" : 20]> g (float[1,4] x) => (float[1,4] y) { y = Relu(x) }'
HALVES = FLOATS.replace("float[1,4] y) {", "float[1,4] y) <float16[1] h = {1}> {")
PAIRS = FLOATS.replace("float[1,4] y) {", "float[1,4] y) <int8 z = {0}> {")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache/engines"


def test_a_build_is_used_again_once_it_is_proven(cache: Path) -> None:
    first = EngineCache(("graph", "card"))
    (first.path / "plan").write_text("built")
    assert not EngineCache(("graph", "card")).proven
    first.keep()
    again = EngineCache(("graph", "card"))
    assert again.proven
    assert (again.path / "plan").read_text() == "built"
    for other in (("graph2", "card"), ("graph", "card2"), ("graphcard",), ("graph", "card", "")):
        assert not EngineCache(other).proven
    again.discard()
    assert not EngineCache(("graph", "card")).proven


def test_of_two_processes_the_first_build_stays_and_those_of_dead_ones_go(cache: Path) -> None:
    first = EngineCache(("graph",))
    shutil.copytree(first.path, left := first.path.with_name(f"{first.path.name.partition('.')[0]}.building-999999999"))
    second = EngineCache(("graph",))
    assert not left.exists()
    first.keep()
    second.path = second.path.with_name("late")
    second.path.mkdir()
    (first.path / "plan").write_text("first")
    second.keep()
    assert (second.path / "plan").read_text() == "first"
    assert [path.name for path in cache.iterdir()] == [first.path.name]


def options_of(folder: Path, text: str, **more: Any) -> dict[str, str]:
    path = folder / "graph.onnx"
    onnx.save(onnx.parser.parse_model(text), path)
    session = object.__new__(OrtTensorrtSession)
    session._shapes, session.cache = more.get("shapes", {}), more.get("cache")
    (name, options), *others = session._providers_for(path)
    assert (name, others[0][0]) == ("TensorrtExecutionProvider", "CUDAExecutionProvider")
    return dict(options)


def test_its_options_follow_from_the_graph_the_spec_and_the_cache(tmp_path: Path) -> None:
    assert options_of(tmp_path, FLOATS) == {"trt_max_workspace_size": str(1 << 30)}
    assert options_of(tmp_path, HALVES)["trt_fp16_enable"] == "1"
    assert options_of(tmp_path, PAIRS)["trt_int8_enable"] == "1"
    found = options_of(tmp_path, FLOATS, shapes={"x": (1, 4), "n": (1, 12)}, cache=EngineCache(("key",)))
    for bound in ("min", "opt", "max"):
        assert found[f"trt_profile_{bound}_shapes"] == "x:1x4,n:1x12"
    assert found["trt_engine_cache_enable"] == found["trt_timing_cache_enable"] == "1"
    assert found["trt_engine_cache_path"].startswith(str(tmp_path))


def test_its_identity_names_the_release_of_tensorrt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ort_tensorrt, "versions", lambda _: {"tensorrt": "10.3.0"})
    one = OrtTensorrtSession.identity()
    assert one.startswith("TensorrtExecutionProvider {")
    assert "TensorRT 10.3.0" in one
    monkeypatch.setattr(ort_tensorrt, "versions", lambda _: {})
    assert OrtTensorrtSession.identity() != one


def test_the_shapes_of_a_graph_are_those_of_spec_and_program_or_not_known(float_bundle: Bundle) -> None:
    manifest = float_bundle.manifest
    assert input_shapes(manifest, "main") == {
        "image": (1, 8, 8, 3), "proprio": (1, 3), "instruction": (1, 4)
    }  # fmt: skip
    given = SimpleNamespace(spec=manifest.spec, program=[ProgramStep("main", {"x": "of another graph"}, {"y": "y"})])
    assert input_shapes(given, "main") == {}


class BuildingSession(OrtCpuSession):
    """The processor's session, which builds something as TensorRT does."""

    caches = True

    def __init__(self, *given: Any, cache: str = "", shapes: Any = None, **more: Any) -> None:
        self.cache = EngineCache((cache, repr(shapes)))
        built.append(self.cache.proven)
        super().__init__(*given, **more)


built: list[bool] = []


def test_load_keeps_what_gave_the_golden_action_and_discards_the_rest(
    float_bundle: Bundle, monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    monkeypatch.setattr("vlatool.runtime.policy.engine_class", lambda _: BuildingSession)
    built.clear()
    vlatool.load(float_bundle.path, threads=1)
    vlatool.load(float_bundle.path, threads=1)
    assert built == [False, True]
    real = BuildingSession.run
    monkeypatch.setattr(
        BuildingSession, "run", lambda self, feeds: {name: value + 1 for name, value in real(self, feeds).items()}
    )
    with pytest.raises(GraphError, match="different golden action"):
        vlatool.load(float_bundle.path, threads=1)
    assert list(cache.iterdir()) == []
    vlatool.load(float_bundle.path, threads=1, golden_tolerance=1e9, warmup=0)
    assert built == [False, True, True, False]
    assert [".building-" in path.name for path in cache.iterdir()] == [True]
